"""Headers of weights files; requires no PyTorch."""

from pathlib import Path

from safetensors import SafetensorError, safe_open

from ..errors import WeightsError
from ..files.reading import WEIGHTS, check_regular
from ..wording import shortened

FORMATS = (
    ("carts-feature-network", "1"),
    ("carts-surface-network", "1"),
    ("carts-surface-network", "2"),
)
"""Supported formats with their versions."""
REMEDY = "Train weights with `carts train`, or reinstall carts to restore the shipped weights."


def read_header(path: Path) -> tuple[dict[str, str], dict[str, tuple[int, ...]]]:
    """Read the metadata, of a supported version, and the shape of every tensor."""
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}
    except (FileNotFoundError, IsADirectoryError) as error:
        raise WeightsError(f"weights file {path} is missing. {REMEDY}") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise unreadable(path, error) from error
    if (metadata.get("format"), metadata.get("version")) not in FORMATS:
        allowed = " or ".join(f"{name!r}, version {version!r}" for name, version in FORMATS)
        raise WeightsError(
            f"weights file {path} has format {metadata.get('format')!r}, version {metadata.get('version')!r}; allowed: "
            f"{allowed}. {REMEDY}"
        )
    return metadata, shapes


def is_surface(path: Path) -> bool:
    """Whether a weights file contains a surface network; `WeightsError` if its header cannot be read."""
    return read_header(path)[0]["format"] == "carts-surface-network"


def unreadable(path: Path, error: Exception) -> WeightsError:
    """Error for a file that safetensors cannot read."""
    return WeightsError(
        f"weights file {path} is not a readable safetensors file of `carts train` ({shortened(str(error))}). {REMEDY}"
    )
