"""`python -m tools.bench_core`: times and ratios of the core on the shipped sequence, measured on this machine.

Each value is the median of repeated runs in one process; ratios depend less on the machine than times.
"""

import argparse
from pathlib import Path

from rich.table import Table

from carts_core.console import Terminal
from carts_core.lab.benchmark.measurement import optimizer_figures, render_figures
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence
from carts_core.wording import counted


def main() -> None:
    """Print the table."""
    tune_process()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--runs", type=int, default=30)
    arguments = parser.parse_args()
    sequence = Sequence.open(arguments.sequence)
    camera = sequence.scene.cameras[0]
    faces = sum(len(mesh.faces) for arm in sequence.scene.arms for mesh in arm.robot.meshes)
    arms = counted(len(sequence.scene.arms), "arm")
    table = Table(title=f"{sequence.name}: {arms}, {faces} triangles, {camera.width}x{camera.height}")
    table.add_column("what")
    table.add_column("ms", justify="right")
    for name, value in {
        **render_figures(sequence, arguments.runs),
        **optimizer_figures(sequence, arguments.runs),
    }.items():
        table.add_row(name, f"{value:.1f}")
    Terminal().print(table)


if __name__ == "__main__":
    main()
