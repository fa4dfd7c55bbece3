"""What every module in this package offers."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ...settings.importing import ImportOptions
from ..importing.found import FoundRecording


@dataclass(frozen=True)
class Source:
    """A kind of recording that can be imported."""

    name: str
    """As `--source` calls it."""
    label: str
    """For people."""
    looked_for: str
    """What shows that a folder or file is of this kind, for people."""
    detect: Callable[[Path], bool]
    """Whether a path is of this kind; quick, and without an error whatever the path is."""
    uses: tuple[str, ...]
    """Names of the `ImportOptions` that it uses beside those of arms, robots and calibrations, which all do."""
    read: Callable[[Path, ImportOptions], FoundRecording]
    """Everything that is found; raises a `CartsError` for what is damaged or contradicts itself."""
