"""The `carts` command. Each subcommand is a dataclass whose fields are its options and whose `run` does the work."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Annotated

import tyro

from ..console import Terminal, log_to_stderr
from ..errors import CartsError, SettingsError
from ..imports import uncollected
from ..stopping import PARENT, end_with_parent, exit_status, message, stopped_by_signals
from .baseline import Baseline
from .batch import Batch
from .bench import Bench
from .calibrate import Calibrate
from .evaluate import Evaluate
from .export import Export
from .hand_eye import HandEye
from .import_ import Import
from .import_masks import ImportMasks
from .live import Live
from .optimize import Optimize
from .render import Render
from .robot import RobotCommand
from .robots import Robots
from .synthesize import Synthesize
from .time_offset import TimeOffset
from .train import Train
from .view import View

_DESCRIPTION = (
    "Correct a surgical robot's kinematics from its endoscope image. `carts --version` tells which version this is. "
    "After a command, --help-all also lists every setting of the solvers, and --print-settings writes them as a file "
    "for --settings."
)

BAD_INPUT = 2
"""Exit status when a file or an option is not usable."""

Command = (
    Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[ImportMasks, tyro.conf.subcommand("import-masks")]
    | Annotated[HandEye, tyro.conf.subcommand("hand-eye")]
    | Annotated[TimeOffset, tyro.conf.subcommand("time-offset")]
    | Annotated[Optimize, tyro.conf.subcommand("optimize")]
    | Annotated[Live, tyro.conf.subcommand("live")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Batch, tyro.conf.subcommand("batch")]
    | Annotated[RobotCommand, tyro.conf.subcommand("robot")]
    | Annotated[Robots, tyro.conf.subcommand("robots")]
    | Annotated[Synthesize, tyro.conf.subcommand("synthesize")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Baseline, tyro.conf.subcommand("baseline")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; errors that are meant for people end it with one message and status 2."""
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
                print_all_help(arguments)
                return
            arguments = [argument for argument in arguments if argument != "--print-settings"]
            command = tyro.cli(Command, prog="carts", description=_DESCRIPTION, args=arguments)  # pyright: ignore
            if print_settings:
                print(_settings_of(command))
                return
        with uncollected():
            from ..process import tune_process

        log_to_stderr()
        tune_process(keep_memory=not isinstance(command, View))
        with stopped_by_signals():
            command.run()
    except CartsError as error:
        Terminal(stderr=True).print_error(error)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt as stopped:
        Terminal(stderr=True).print(message(stopped), soft_wrap=True)
        sys.exit(exit_status(stopped))


def print_all_help(arguments: list[str]) -> None:
    """Print a command's options and then all settings that a settings file can hold."""
    from .help_all import settings_reference

    try:
        shown = [argument if argument != "--help-all" else "--help" for argument in arguments]
        tyro.cli(Command, prog="carts", description=_DESCRIPTION, args=shown)  # pyright: ignore
    except SystemExit:
        print(settings_reference())


def _settings_of(command: object) -> str:
    """The settings that a command would use, as a settings file.

    Raises:
        SettingsError: it has none.
    """
    solving = getattr(command, "solving", None)
    if solving is None:
        raise SettingsError("--print-settings is for `carts optimize`, `carts evaluate` and `carts calibrate`.")
    return solving.printed()


@contextmanager
def _quiet_when_unread() -> Iterator[None]:
    """End without a traceback where whoever reads the output, such as `head`, has seen enough."""
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:
        # Python flushes once more at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
