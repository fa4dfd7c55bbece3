"""Networks of a recording: the initial network of the viewer, and adapted networks."""

import json
import re
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from carts_core.errors import CartsError
from carts_core.files import output_path, write_text
from carts_core.files.reading import WEIGHTS, Kind, is_regular, parse_json, read_bytes, read_text, typed
from carts_viewer.jobs.companions import Decisions, set_aside_damaged
from carts_viewer.jobs.optimizers import OptimizerFactory

STARTED = "As started"
"""Label of the initial network: the shipped network, or that of `--weights`."""
_WEIGHTS_FILE = "surface.safetensors"
_ADAPTED = "Adapted {}"
_FILE = Kind("network selection", 2**12)
_MAX_NAME = 40
"""Maximum length of a network's name [characters]."""


@dataclass(frozen=True)
class _Choice:
    """Content of the file."""

    network: str


class Networks:
    """The surface network that all tabs use; the choice is kept in `PROJECT_network.json` beside the project.

    Weights that this user has not trained on this computer are used only after the user has accepted them.

    Attributes:
        names: labels of the networks to choose from.
        used: label of the network in use.
        asked: label of a chosen network whose weights are not accepted yet; empty if there is none.
        problem: reason why the saved choice is not used; empty if it is used.
    """

    def __init__(self, project: Path, *, kept: bool, optimizers: OptimizerFactory, decisions: Decisions) -> None:
        """`kept`: whether files may be written beside the project."""
        self._project, self._kept, self._optimizers, self._decisions = project, kept, optimizers, decisions
        self._file = output_path(project.parent, f"{project.stem}_network.json")
        self.names: tuple[str, ...] = ()
        self.used = STARTED
        self.asked = self.problem = ""
        self.update_names()
        remembered = self._read()
        try:
            if remembered != STARTED and not optimizers.given_surface():
                self._resume(remembered)
        except (OSError, CartsError) as error:
            self.problem = (
                f"The network {remembered!r}, which was selected last, cannot be used: {str(error).rstrip('.')}."
            )

    def update_names(self) -> None:
        """Update `names` from the folders beside the project."""
        numbers = [number for number in self._numbers() if is_regular(self.folder(number) / _WEIGHTS_FILE)]
        self.names = (STARTED, *(_ADAPTED.format(number) for number in numbers))

    def folder(self, number: int) -> Path:
        """Folder of an adapted network, by its number."""
        return self._project.with_name(f"{self._project.stem}_adapted_{number}")

    def next_number(self) -> int:
        """Number of the next adapted network."""
        return max(self._numbers(), default=0) + 1

    def use(self, name: str) -> None:
        """Use a network from now on and save the choice; weights of another user must be accepted first.

        Raises:
            CartsError: the name is unknown, or the weights cannot be used.
        """
        self.update_names()
        if name not in self.names:
            raise CartsError(f"Unknown network {name!r}. Choose one of: {', '.join(self.names)}.")
        self.asked = "" if name == STARTED or self._decisions.find(self._weights(name)) else name
        if not self.asked:
            self._run(name)
            if self._kept:
                write_text(self._file, json.dumps(asdict(_Choice(name))))

    def answer(self, accepted: bool) -> None:
        """Accept or refuse the weights that need confirmation.

        Raises:
            CartsError: no weights need confirmation, or the weights cannot be used.
        """
        name, self.asked = self.asked, ""
        if not name:
            raise CartsError("No network needs to be accepted.")
        self._decisions.make(self._weights(name), accepted)
        if accepted:
            self.use(name)

    def trained(self, number: int) -> None:
        """Accept the weights of the adapted network with this number, which this viewer has trained."""
        with suppress(OSError, CartsError):
            self._decisions.make(self._weights(_ADAPTED.format(number)), True)

    def _resume(self, name: str) -> None:
        """Use the network that was chosen last, or ask for confirmation; refused weights are not used."""
        if name not in self.names:
            raise CartsError("it no longer exists")
        accepted = self._decisions.find(self._weights(name))
        if accepted:
            self._run(name)
        elif accepted is None:
            self.asked = name

    def _run(self, name: str) -> None:
        self._optimizers.use(None if name == STARTED else self._weights_file(name))
        self.used, self.problem = name, ""

    def _weights_file(self, name: str) -> Path:
        return self.folder(int(name.rpartition(" ")[2])) / _WEIGHTS_FILE

    def _weights(self, name: str) -> bytes:
        """Content of the weights of an adapted network.

        Raises:
            CartsError: the weights cannot be read.
        """
        path = self._weights_file(name)
        try:
            return read_bytes(path, WEIGHTS)
        except OSError as error:
            raise CartsError(f"{path} cannot be read ({error}). Adapt the network again.") from error

    def _numbers(self) -> list[int]:
        named = re.compile(re.escape(self._project.stem) + r"_adapted_([1-9]\d{0,5})")
        beside = self._project.parent.iterdir() if self._project.parent.is_dir() else ()
        found = (named.fullmatch(path.name) for path in beside)
        return sorted(int(match[1]) for match in found if match is not None)

    def _read(self) -> str:
        """Name of the network that was chosen last."""
        try:
            return typed(parse_json(read_text(self._file.path, _FILE)), _Choice).network[:_MAX_NAME]
        except FileNotFoundError:
            return STARTED
        except (OSError, ValueError) as error:
            effect = "The viewer's initial network is used"
            self.problem = set_aside_damaged(self._file.path, "network selection", error, effect, writable=self._kept)
            return STARTED
