"""The `carts` command. Each subcommand is a dataclass of options whose `run` method does the work."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from importlib import import_module
from importlib.metadata import version
from operator import or_
from typing import Annotated, Any, get_args

import tyro

from ..console import Terminal, log_to_stderr
from ..errors import CartsError, SettingsError
from ..package_imports import gc_paused
from ..stopping import PARENT, end_with_parent, exit_status, message, stopped_by_signals
from ..wording import closest


def settings_reference() -> str:
    """Description of all settings of a settings file, with defaults and meanings."""
    from ..settings import DescentSolver, SequenceSettings, SurfaceSolver
    from ..settings.serialization import described
    from ..settings.stages import Stage

    parts = [
        "Settings in the tables [solver] and [sequence] of `--settings FILE`; --print-settings writes all of them.",
        *(described(kind) for kind in (SurfaceSolver, DescentSolver, SequenceSettings)),
        "Stages: tables [[solver.stages]], whose key `stage` is the name of the stage:",
        *(described(kind) for kind in get_args(Stage)),
    ]
    return "\n\n".join(parts)


_DESCRIPTION = (
    "Correct a surgical robot's kinematics from its endoscope image. `carts --version` prints the version. "
    "COMMAND --help-all also lists every setting of the solvers; COMMAND --print-settings prints a file "
    "for --settings."
)

BAD_INPUT = 2
"""Exit status for an invalid file or option."""

COMMANDS = {
    "view": ("view", "View"),
    "import": ("importing", "Import"),
    "import-masks": ("importing", "ImportMasks"),
    "hand-eye": ("calibrate", "HandEye"),
    "time-offset": ("calibrate", "TimeOffset"),
    "optimize": ("optimize", "Optimize"),
    "live": ("live", "Live"),
    "evaluate": ("optimize", "Evaluate"),
    "calibrate": ("calibrate", "Calibrate"),
    "render": ("export", "Render"),
    "export": ("export", "Export"),
    "batch": ("batch", "Batch"),
    "robot": ("robots", "RobotCommand"),
    "robots": ("robots", "Robots"),
    "synthesize": ("lab", "Synthesize"),
    "train": ("lab", "Train"),
    "baseline": ("lab", "Baseline"),
    "bench": ("lab", "Bench"),
}
"""Subcommand -> module and dataclass with its options and `run` method. Only the module of the given subcommand is
imported."""
_AT_ONCE = ("view", "live", "robot", "robots")
"""Commands that do not announce their start."""
_WITHOUT_TORCH = ("view", "batch")
"""Commands that import PyTorch only to solve."""


def command_class(name: str, options: Sequence[str] = ()) -> Any:
    """Dataclass of a subcommand with these options."""
    if name == "bench" and options:
        from .lab import BenchDataSet, DataSet

        if options[0] in get_args(DataSet):
            return BenchDataSet
    if name == "train" and any(option.split("=")[0] == "--for" for option in options):
        from .lab import Adapt

        return Adapt
    module, kind = COMMANDS[name]
    return getattr(import_module(f".{module}", __package__), kind)


def any_command() -> Any:
    """Union of all subcommands."""
    return reduce(or_, (Annotated[command_class(name), tyro.conf.subcommand(name)] for name in COMMANDS))


_INVALID_CHOICE = re.compile(r"invalid choice '(?P<given>[^']*)' for .*?Expected one of \((?P<known>[^)]*)\)")
"""Pattern of tyro's error message, without the surrounding box."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a `CartsError` ends it with a message and status 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if parent := os.environ.pop(PARENT, ""):
        end_with_parent(int(parent))
    try:
        with _quiet_when_unread():
            if arguments == ["--version"]:
                print(f"carts {version('carts')}")
                return
            print_settings = "--print-settings" in arguments
            if "--help-all" in arguments:
                shown = [argument if argument != "--help-all" else "--help" for argument in arguments]
                with contextlib.suppress(SystemExit):
                    tyro.cli(any_command(), prog="carts", description=_DESCRIPTION, args=shown)  # pyright: ignore
                print(settings_reference())
                return
            arguments = [argument for argument in arguments if argument != "--print-settings"]
            command = _parsed(arguments)
            if print_settings:
                if not hasattr(command, "solving"):
                    named = "`carts optimize`, `carts evaluate` and `carts calibrate`"
                    raise SettingsError(f"--print-settings is available for {named}.")
                print(command.solving.printed())
                return
        if arguments[0] not in _AT_ONCE:
            # The imports may take seconds on a busy machine.
            Terminal(stderr=True).print(f"carts {arguments[0]}: starting", style="dim")
        with gc_paused():
            from ..process import keep_memory, tune_process

        log_to_stderr()
        keep_memory() if arguments[0] in _WITHOUT_TORCH else tune_process()
        with stopped_by_signals():
            command.run()
    except CartsError as error:
        Terminal(stderr=True).print_error(error)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt as stopped:
        Terminal(stderr=True).print(message(stopped), soft_wrap=True)
        sys.exit(exit_status(stopped))


def _parsed(arguments: list[str]) -> Any:
    """Parse a command line; tyro exits the program after help or an error."""
    name, *options = arguments or [""]
    if name and not name.startswith("-") and name not in COMMANDS:
        meant = closest(name, COMMANDS)
        raise SettingsError(f"there is no command {name!r}.{meant} The commands are: {', '.join(COMMANDS)}.")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            if name in COMMANDS:
                # For a misspelt option, suggest only options of the same command.
                return tyro.cli(command_class(name, options), prog=f"carts {name}", args=options)
            return tyro.cli(any_command(), prog="carts", description=_DESCRIPTION, args=arguments)  # pyright: ignore
    except SystemExit:
        print(said.getvalue(), end="", file=sys.stderr)
        if found := _INVALID_CHOICE.search(" ".join(said.getvalue().replace("│", " ").split())):
            print(closest(found["given"], re.findall("'([^']*)'", found["known"])).strip(), file=sys.stderr)
        raise


@contextmanager
def _quiet_when_unread() -> Iterator[None]:
    """Exit without a traceback if the reader of the output, such as `head`, has closed the pipe."""
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:
        # Python flushes the output again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
