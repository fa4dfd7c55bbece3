"""Choices of a tab that its jobs use: images, solver and target. They are stored with each job."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from carts_core.errors import SettingsError
from carts_core.files.reading import typed
from carts_core.settings import Direction, FreeParameters, SolverName, SolverSettings, solver
from carts_core.settings.serialization import changed

Observe = Literal["network", "masks", "both"]
Masks = Literal["recording", "imported", "painted"]


@dataclass(frozen=True)
class Observed:
    """The user's choice of the target of a run.

    Raises:
        SettingsError: a value is not one of the choices.
    """

    what: Observe = "network"
    """The target, as in `--observe`."""
    masks: Masks = "recording"
    """Source of the masks, if masks are fitted; as in `--masks`."""

    def __post_init__(self) -> None:
        for value, allowed in ((self.what, get_args(Observe)), (self.masks, get_args(Masks))):
            if value not in allowed:
                raise SettingsError(f"{value!r} is not a target of runs. Choose one of: {', '.join(allowed)}.")


@dataclass(frozen=True)
class Choices:
    """Choices of a tab that its jobs use; the fields are those of `ViewState`."""

    domain: str
    camera: str
    every_camera: bool
    solver: SolverName
    settings: SolverSettings
    free: FreeParameters
    observed: Observed
    direction: Direction


@dataclass(frozen=True)
class _Row(Choices):
    """Choices in the format of the list of jobs."""

    settings: dict[str, Any]  # pyright: ignore[reportIncompatibleVariableOverride]


def read_choices(values: Mapping[str, Any]) -> Choices:
    """Choices with checked types and ranges, from the values of `to_plain`; names of the recording are not checked.

    Raises:
        ValueError: a value is missing, of the wrong type or out of range.
    """
    row = typed(values, _Row)
    try:
        settings = changed(solver(row.solver), row.settings, "the solver")
    except SettingsError as error:
        raise ValueError(str(error).removesuffix(".")) from error
    return Choices(**{**vars(row), "settings": settings})
