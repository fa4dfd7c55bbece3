"""The networks that there are for a recording: those that the viewer was started with, and those adapted to it."""

import json
import re
from contextlib import suppress
from pathlib import Path

from carts_core.errors import CartsError
from carts_core.files import output_path, write_text
from carts_core.files.reading import Kind, is_regular, read_text
from carts_viewer.running import OptimizerFactory

STARTED = "As started"
"""What people read for the network that the viewer was started with: the shipped one, or that of `--weights`."""
WEIGHTS = "surface.safetensors"
_ADAPTED = "Adapted {}"
_FILE = Kind("choice of a network", 2**12)


class Networks:
    """Which network runs, for everybody; the choice is kept in `PROJECT_network.json` beside the project.

    Attributes:
        names: what people can choose from.
        used: the one that runs.
    """

    def __init__(self, project: Path, *, kept: bool, optimizers: OptimizerFactory) -> None:
        """
        Args:
            project: The project's file, beside which networks lie that were adapted.
            kept: Whether anything may be written there.
            optimizers: Run the network.
        """
        self._project, self._kept, self._optimizers = project, kept, optimizers
        self.names: tuple[str, ...] = ()
        self.used = STARTED
        self.look()
        remembered = self._read()
        if remembered in self.names[1:]:
            # Weights that cannot be read any more are not used.
            with suppress(CartsError):
                if not optimizers.given_surface():
                    self._run(remembered)

    def look(self) -> None:
        """See which there are."""
        numbers = [number for number in self._numbers() if is_regular(self.folder(number) / WEIGHTS)]
        self.names = (STARTED, *(_ADAPTED.format(number) for number in numbers))

    def folder(self, number: int) -> Path:
        """Of a run that adapts, by its number."""
        return self._project.with_name(f"{self._project.stem}_adapted_{number}")

    def next_number(self) -> int:
        """Of a run that is begun now."""
        return max(self._numbers(), default=0) + 1

    def use(self, name: str) -> None:
        """Have a network run from now on, and remember it.

        Raises:
            CartsError: there is none of this name, or its weights cannot be used.
        """
        self.look()
        if name not in self.names:
            raise CartsError(f"There is no network {name!r}. There are: {', '.join(self.names)}.")
        self._run(name)
        if self._kept:
            path = output_path(self._project.parent, f"{self._project.stem}_network.json")
            write_text(path, json.dumps({"network": name}))

    def _run(self, name: str) -> None:
        number = None if name == STARTED else int(name.rpartition(" ")[2])
        self._optimizers.use(None if number is None else self.folder(number) / WEIGHTS)
        self.used = name

    def _numbers(self) -> list[int]:
        named = re.compile(re.escape(self._project.stem) + r"_adapted_([1-9]\d{0,5})")
        beside = self._project.parent.iterdir() if self._project.parent.is_dir() else ()
        found = (named.fullmatch(path.name) for path in beside)
        return sorted(int(match[1]) for match in found if match is not None)

    def _read(self) -> str:
        try:
            file = self._project.with_name(f"{self._project.stem}_network.json")
            return str(json.loads(read_text(file, _FILE))["network"])
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return STARTED
