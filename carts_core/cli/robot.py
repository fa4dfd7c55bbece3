"""`carts robot`: a robot from dVRK's own models, as a URDF that every command takes."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from rich.table import Table

from ..console import Terminal
from ..errors import RobotError


@dataclass(frozen=True)
class RobotCommand:
    """Make a URDF of an arm with one of the instruments of dvrk_model; without --instrument, list these."""

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """Checkout of https://github.com/jhu-dvrk/dvrk_model: the folder with `urdf` and `meshes`."""
    instrument: str | None = None
    """Last six digits of its model number: 400... for the classic arm, 420... for Si."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """URDF to write; by default `psm_NUMBER.urdf` here."""
    overwrite: bool = False
    """Replace a file that is there."""

    def run(self) -> None:
        """Write the URDF, once all its meshes have been read."""
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
            raise RobotError(f"{output} exists. Add --overwrite to replace it, or name another file with -o.")
        with TemporaryDirectory() as folder:
            trial = Path(folder) / output.name
            write_text(trial, dvrk_urdf(self.model, self.instrument, trial.parent))
            robot = Robot.load(trial, progress=console.print)
        write_text(output, dvrk_urdf(self.model, self.instrument, output.absolute().parent))
        console.print(f"wrote {output}: joints {', '.join(robot.joint_names)}")
        console.print(f"meshes: {robot.decimation}")
        console.print(f'In a sequence file: robot = "{output.name}", as a path from that file.', markup=False)
