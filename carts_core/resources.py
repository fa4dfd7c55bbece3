"""Paths of shipped files, which are next to the packages in a checkout and in `carts_core` in a wheel."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def _shipped(name: str) -> Path:
    inside_wheel = _PACKAGE / name
    return inside_wheel if inside_wheel.is_dir() else _PACKAGE.parent / name


def sample_data_dir() -> Path:
    """Folder with the shipped robot, sequence and weights."""
    return _shipped("sample_data")


def static_dir() -> Path:
    """Folder with static files of the page: scripts, styles, help, icons."""
    return _shipped("static")


def sample_sequence() -> Path:
    """The shipped sequence file."""
    return sample_data_dir() / "sequence" / "sequence.toml"


def shipped_robot() -> Path:
    """URDF of the shipped PSM with a Large Needle Driver."""
    return sample_data_dir() / "robots" / "psm_lnd" / "psm_lnd.urdf"


def shipped_weights() -> tuple[Path, Path]:
    """Weights of the shipped feature network and of the shipped surface network."""
    folder = sample_data_dir() / "weights"
    return folder / "features.safetensors", folder / "surface.safetensors"


def shipped_int8() -> Path:
    """The shipped surface network, quantized to 8-bit integers for ONNX Runtime (`tools/quantize_network.py`)."""
    return sample_data_dir() / "weights" / "surface_int8.onnx"
