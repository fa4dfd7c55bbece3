"""MATLAB's files (version 5), which may not expand without end."""

import io
import zlib
from pathlib import Path
from typing import Any

from ...files.reading import CALIBRATION, MIB, read_bytes

_HEADER = 128
_COMPRESSED = 15
_LARGEST = 64 * MIB
"""Of all variables, expanded [bytes]."""


def read_matlab(path: Path) -> dict[str, Any]:
    """Variables by name; structs as dictionaries.

    Raises:
        OSError: it is missing, or no regular file of the size of a calibration.
        ValueError: it is damaged, of another version, or expands to too much.
    """
    from scipy.io import loadmat  # noqa: PLC0415

    content = read_bytes(path, CALIBRATION)
    _check_expansion(content)
    try:
        variables = loadmat(io.BytesIO(content), simplify_cells=True)
    except Exception as error:  # scipy raises whatever its readers meet
        raise ValueError(f"it is no MATLAB file of version 5 ({error})") from error
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _check_expansion(content: bytes) -> None:
    order = "little" if content[126:128] == b"IM" else "big"
    position, left = _HEADER, _LARGEST
    while position + 8 <= len(content):
        kind = int.from_bytes(content[position : position + 4], order)
        length = int.from_bytes(content[position + 4 : position + 8], order)
        if kind == _COMPRESSED:
            try:
                left -= len(zlib.decompressobj().decompress(content[position + 8 : position + 8 + length], left + 1))
            except zlib.error as error:
                raise ValueError(f"a variable of it is damaged ({error})") from error
        if left < 0:
            raise ValueError(f"it expands to more than {_LARGEST // MIB} MiB")
        position += 8 + length
