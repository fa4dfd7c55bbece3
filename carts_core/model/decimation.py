"""Fewer triangles for a mesh, in a process of its own, so that it can be stopped after a time, and by Ctrl-C.

The library that does it neither looks at signals nor ends in good time on every mesh: 300,000 triangles at random take
it longer than ten minutes.
"""

import io
import resource
import subprocess
import sys

import numpy as np
from jaxtyping import Float, Int

_SECONDS = 8.0
_SECONDS_PER_FACE = 5e-5
"""Some five times what meshes of instruments need."""
_MEMORY = 2 * 2**30


class DecimationError(Exception):
    """A mesh was not decimated in the time and memory that meshes of its size need."""


def decimated(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Vertices and faces of a mesh with about `count` triangles.

    Raises:
        DecimationError: it takes too long or too much memory, or fails.
    """
    given = io.BytesIO()
    np.savez(given, vertices=vertices, faces=faces, count=count)
    seconds = _SECONDS + _SECONDS_PER_FACE * len(faces)
    # The file alone: importing the package would take longer than most meshes.
    command = [sys.executable, "-P", __file__]
    try:
        done = subprocess.run(command, input=given.getvalue(), capture_output=True, timeout=seconds, check=True)
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as result:
            return result["vertices"], result["faces"]
    except subprocess.TimeoutExpired as error:
        raise DecimationError(f"it was not simplified within {seconds:.0f} s") from error
    except (subprocess.CalledProcessError, OSError, ValueError, KeyError) as error:
        raise DecimationError("it cannot be simplified") from error


def _main() -> None:
    import fast_simplification  # noqa: PLC0415 - only the process that decimates needs it

    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as given:
        vertices, faces, *_ = fast_simplification.simplify(
            points=given["vertices"], triangles=given["faces"], target_count=int(given["count"])
        )
    result = io.BytesIO()
    np.savez(result, vertices=vertices, faces=faces)
    sys.stdout.buffer.write(result.getvalue())


if __name__ == "__main__":
    _main()
