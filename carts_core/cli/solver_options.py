"""Which solver a command uses: a name, and a file for what is to be different."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tomlkit
import tyro

from ..errors import SettingsError
from ..files.reading import SETTINGS, parse_toml, read_text
from ..settings import CALIBRATION_SETTINGS, FreeParameters, SequenceSettings, SolverName, SolverSettings, SurfaceSolver
from ..settings import solver as named_solver
from ..settings.serialization import changed, to_plain


@dataclass(frozen=True)
class FreeInFrames(FreeParameters):
    """The same without what is rarely needed for frames; --settings has it."""

    locked_cameras: tyro.conf.Suppress[tuple[str, ...]] = ()


@dataclass(frozen=True)
class SolverOptions:
    """Which solver, and with what settings."""

    solver: Annotated[SolverName, tyro.conf.EnumChoicesFromValues] = SolverName.SURFACE
    """Solver: `surface` is the default; `occluded` runs again without occluded pixels; `acs`, `acs_reference`, `l1` and
    `paper` compare image features as the paper does; `none` only compares the start."""
    settings: tuple[str, ...] = ()
    """Settings that differ from the solver's: TOML files as --print-settings writes them, or single ones such as
    `iterations=20`, `sequence.initial_frames=3` and `free.locked_cameras=["left"]`."""

    def __post_init__(self) -> None:
        _ = self.chosen, self.sequence, self.freed(FreeParameters())  # A file that cannot be used is reported at once.

    @property
    def chosen(self) -> SolverSettings:
        """The solver's settings."""
        return changed(named_solver(self.solver), _table(self.settings, "solver"), "[solver]")

    @property
    def sequence(self) -> SequenceSettings:
        """Settings of sequence mode."""
        return changed(SequenceSettings(), _table(self.settings, "sequence"), "[sequence]")

    def freed(self, free: FreeParameters) -> FreeParameters:
        """What is free, from options and settings."""
        return changed(free, _table(self.settings, "free"), "[free]")

    def check_surface(self, what: str) -> None:
        """Check that the solver is the one that estimates its uncertainty.

        Raises:
            SettingsError: it is not.
        """
        if not isinstance(self.chosen, SurfaceSolver):
            raise SettingsError(f"{what} needs the solver surface; given is --solver {self.solver}. Leave it out.")

    def printed(self) -> str:
        """All settings as a settings file."""
        return printed({"solver": to_plain(self.chosen), "sequence": to_plain(self.sequence)})


@dataclass(frozen=True)
class CalibrationOptions:
    """Settings of a calibration."""

    settings: tuple[str, ...] = ()
    """Settings that differ from the default ones: TOML files as --print-settings writes them, or single ones such as
    `iterations=20`."""

    def __post_init__(self) -> None:
        _ = self.chosen

    @property
    def chosen(self) -> SurfaceSolver:
        """The solver's settings."""
        return changed(CALIBRATION_SETTINGS, _table(self.settings, "solver"), "[solver]")

    def printed(self) -> str:
        """All settings as a settings file."""
        return printed({"solver": to_plain(self.chosen)})


def printed(tables: dict[str, Any]) -> str:
    """Tables as TOML."""
    return tomlkit.dumps(tables)


def _table(given: tuple[str, ...], name: str) -> dict[str, Any]:
    """A table of what --settings names; later ones win.

    Raises:
        SettingsError: a file cannot be read, or something is no TOML or has other tables.
    """
    found: dict[str, Any] = {}
    for text in given:
        single = "=" in text and not Path(text).exists()
        content = _parsed(text, _of_solver(text) if single else _read(Path(text)))
        strangers = set(content) - {"solver", "sequence", "free"}
        if strangers or not all(isinstance(table, dict) for table in content.values()):
            wrong = ", ".join(sorted(strangers)) or "values outside tables"
            raise SettingsError(
                f"--settings {text} has {wrong}; allowed are the tables [solver], [sequence] and [free]."
            )
        found.update(content.get(name, {}))
    return found


def _of_solver(text: str) -> str:
    """A single setting as TOML; one without a table is the solver's, and a bare word is a text."""
    key, _, value = (part.strip() for part in text.partition("="))
    key = key if "." in key else f"solver.{key}"
    try:
        parse_toml(f"value = {value}")
    except ValueError:
        value = json.dumps(value)
    return f"{key} = {value}"


def _read(path: Path) -> str:
    try:
        return read_text(path, SETTINGS)
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(
            f"--settings {path} cannot be read: {error}. Name a file as --print-settings writes, or `NAME=VALUE`."
        ) from error


def _parsed(given: str, text: str) -> dict[str, Any]:
    try:
        return parse_toml(text)
    except ValueError as error:
        raise SettingsError(
            f"--settings {given} is not TOML: {error}. Give a file as --print-settings writes, or `NAME=VALUE`."
        ) from error
