"""`carts robots` lists the built-in robots; `carts robot` creates a URDF from dVRK models."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from rich.table import Column, Table

from ..console import Terminal, track
from ..errors import RobotError
from ..stopping import message_if_stopped


@dataclass(frozen=True)
class Robots:
    """List the built-in robots, for `robot = "builtin:NAME"` in a sequence file."""

    pictures: Path | None = None
    """Folder for pictures of the robots, NAME.png."""

    def run(self) -> None:
        """Print the list, and write pictures if a folder is given."""
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
            'Use: robot = "builtin:NAME". NAME: classic arm (shaft 416.2 mm). NAME_si: Si (467.0 mm). '
            "dVRK: last digits of the model numbers 400... and 420.... Wrist: pitch axis to yaw axis; "
            "tip: yaw axis to tip. Instruments with 6 joints have no jaws.",
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

        with (
            locked_folder(folder),
            message_if_stopped(f"the images written to {folder} so far are complete; the remaining ones are missing"),
        ):
            for name in track(names, "pictures", console=console):
                write_bytes(folder / f"{name}.png", image_png(portrait(Robot.load(SCHEME + name))))
        console.print(f"wrote {folder}")


@dataclass(frozen=True)
class RobotCommand:
    """Create a URDF of an arm with an instrument from dvrk_model; without --instrument, list the instruments."""

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """Checkout of https://github.com/jhu-dvrk/dvrk_model: the folder with `urdf` and `meshes`."""
    instrument: str | None = None
    """Last six digits of the instrument's model number: 400... for the classic arm, 420... for Si."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """URDF to write; by default `psm_NUMBER.urdf` in the current folder."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Write the URDF, after reading all its meshes."""
        from ..files import write_text
        from ..model.dvrk_model import dvrk_urdf, list_instruments
        from ..model.robot import Robot

        console = Terminal()
        if self.instrument is None:
            table = Table("number", "instrument", "arm", "shape")
            for found in list_instruments(self.model).values():
                table.add_row(found.number, found.name, found.generation, "yes" if found.has_tip else "boxes only")
            console.print(table)
            return
        output = self.output or Path(f"psm_{self.instrument}.urdf")
        if output.exists() and not self.overwrite:
            raise RobotError(f"{output} exists. Add --overwrite to replace it, or choose another file with -o.")
        with TemporaryDirectory() as folder:
            trial = Path(folder) / output.name
            write_text(trial, dvrk_urdf(self.model, self.instrument, trial.parent))
            robot = Robot.load(trial, progress=console.print)
        write_text(output, dvrk_urdf(self.model, self.instrument, output.absolute().parent))
        console.print(f"wrote {output}: joints {', '.join(robot.joint_names)}")
        console.print(f"meshes: {robot.decimation}")
        console.print(
            f'In a sequence file: robot = "{output.name}", with the path relative to that file.', markup=False
        )
