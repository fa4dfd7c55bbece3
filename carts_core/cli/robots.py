"""`carts robots`: the robots that are built in."""

from dataclasses import dataclass
from pathlib import Path

from rich.table import Column, Table

from ..console import Terminal, track
from ..stopping import when_stopped


@dataclass(frozen=True)
class Robots:
    """List the robots that are built in, for `robot = "builtin:NAME"` in a sequence file."""

    pictures: Path | None = None
    """Folder for a picture of each, NAME.png."""

    def run(self) -> None:
        """Print the list; make pictures if asked for."""
        from ..model.instruments import INSTRUMENTS, SHIPPED, builtin_names

        console = Terminal()
        table = Table(Column("name", no_wrap=True), "dVRK", "wrist [mm]", "tip [mm]", "joints")
        table.add_row(SHIPPED, "006", "9.1", "9.7", "7")
        for instrument in INSTRUMENTS:
            table.add_row(
                instrument.name,
                instrument.numbers,
                f"{instrument.wrist_length:g}",
                f"{instrument.length:.1f}",
                "7" if instrument.has_jaws else "6",
            )
        console.print(table)
        console.print(
            'Use: robot = "builtin:NAME". NAME is for the classic arm (shaft 416.2 mm), NAME_si for Si (467.0 mm). '
            "dVRK: last digits of the model numbers, 400... and 420.... Wrist: from the pitch axis to the yaw axis; "
            "tip: from there to its end. Instruments with 6 joints have no jaws.",
            soft_wrap=True,
        )
        if self.pictures is not None:
            self._draw(self.pictures, builtin_names(), console)

    def _draw(self, folder: Path, names: tuple[str, ...], console: Terminal) -> None:
        from ..export import image_png
        from ..files import locked_folder, write_bytes
        from ..model.instruments import SCHEME
        from ..model.robot import Robot
        from ..rendering.portrait import portrait

        with locked_folder(folder), when_stopped(f"the pictures in {folder} are whole, some are missing"):
            for name in track(names, "pictures", console=console):
                write_bytes(folder / f"{name}.png", image_png(portrait(Robot.load(SCHEME + name))))
        console.print(f"wrote {folder}")
