"""Process many recordings: correct some frames of each sequence and domain, and write one table of scores.

python examples/09_batch.py [SEQUENCE.toml ...] [--frames 1] [--domains regular smoke] [--table scores.csv]
"""

import csv
import math
from dataclasses import asdict, fields
from pathlib import Path

import tyro
from matplotlib.figure import Figure

from carts_core.errors import CartsError
from carts_core.evaluation import FrameScore, evaluate
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FreeParameters, SurfaceSolver
from carts_core.process import tune_process
from carts_core.recording import Sequence, evenly_spaced
from carts_core.resources import sample_sequence


def main(
    sequences: tyro.conf.Positional[tuple[Path, ...]] = (),
    frames: int = 1,
    domains: tuple[str, ...] = ("regular", "smoke"),
    table: Path = Path("scores.csv"),
    picture: Path = Path("batch.png"),
) -> None:
    """Evaluate every sequence; unreadable ones are reported and left out."""
    extractor = FeatureExtractor.load()
    scores: list[tuple[str, FrameScore]] = []
    for path in sequences or (sample_sequence(),):
        try:
            sequence = Sequence.open(path)
            found = evaluate(
                sequence,
                extractor,
                frames=evenly_spaced(len(sequence), frames),
                cameras=[camera.name for camera in sequence.scene.cameras],
                domains=[domain for domain in sequence.domains if domain in domains] or [sequence.domains[0]],
                settings=SurfaceSolver(),
                free=FreeParameters(),
                perturb_deg=2.0,
            )
            scores += [(sequence.name, score) for score in found]
        except CartsError as error:
            print(f"left out: {error}")

    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["sequence", *(field.name for field in fields(FrameScore))])
        writer.writeheader()
        writer.writerows({"sequence": name, **asdict(score)} for name, score in scores)
    print(f"wrote {table}, {len(scores)} rows")

    figure = Figure((6.4, 1.4 + 0.4 * len(scores)), layout="constrained")
    axes = figure.subplots()
    for row, (_, score) in enumerate(scores):
        # Sequences without masks have no Dice.
        before, after = score.dice_before or math.nan, score.dice_after or math.nan
        axes.plot([before, after], [row, row], color="lightgray", zorder=0)
        axes.scatter(before, row, color="tab:orange", label="" if row else "2 degrees off")
        axes.scatter(after, row, color="tab:blue", label="" if row else "corrected")
    axes.set_yticks(range(len(scores)), [f"{score.domain} {score.frame}" for _, score in scores])
    axes.margins(y=0.4)
    axes.set_xlabel("Dice")
    axes.legend(loc="center")
    figure.savefig(picture, dpi=150)
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
