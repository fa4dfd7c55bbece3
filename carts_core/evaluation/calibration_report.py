"""The folder that a calibration leaves: sequence file, numbers, and a page with plots."""

import json
from collections.abc import Sequence as Frames
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..console import in_markdown
from ..files import OutputPath, output_stream, write_text
from ..optimization import CalibrationResult
from ..recording import Sequence, calibrated_sequence_file
from ..wording import counted
from .calibration import FrameResidual, calibration_json, mean_dice, moved_frames, remark

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_calibration(
    folder: OutputPath, target: Path, sequence: Sequence, result: CalibrationResult, residuals: Frames[FrameResidual]
) -> None:
    """Write `sequence.toml`, `calibration.json`, `frames.png`, `unknowns.png` and `README.md`.

    Args:
        folder: is made, and written to.
        target: where the folder will lie in the end; paths in the sequence file are relative to it.
        sequence: with the calibration as it was.
        result: the new one.
        residuals: of the frames that it was made from.
    """
    text = calibrated_sequence_file(sequence.path, target, sequence.scene, result.scene)
    write_text(folder / "sequence.toml", text)
    content = calibration_json(sequence.scene, result, residuals)
    write_text(folder / "calibration.json", json.dumps(content, indent=1))
    for name, figure in (("frames.png", _frames_figure(residuals)), ("unknowns.png", _unknowns_figure(result))):
        with output_stream(folder / name) as stream:
            figure.savefig(stream, format="png", dpi=110)
    write_text(folder / "README.md", _page(sequence, result, residuals))


def _cameras(residuals: Frames[FrameResidual]) -> list[str]:
    return list(dict.fromkeys(camera for residual in residuals for camera in residual.dice_before))


def _figure(width: float, height: float) -> "Figure":
    """An empty figure of a size [inch]."""
    # They take 0.3 s, and nothing else of what is imported with this module draws.
    import matplotlib  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    matplotlib.use("Agg")
    # Names of frames and cameras are no formulas.
    matplotlib.rcParams["text.parse_math"] = False
    return Figure(figsize=(width, height), layout="constrained")


def _frames_figure(residuals: Frames[FrameResidual]) -> "Figure":
    cameras = _cameras(residuals)
    figure = _figure(7.5, 2.3 * (1 + len(cameras)))
    axes = figure.subplots(1 + len(cameras), 1, squeeze=False, sharex=True)[:, 0]
    names = [residual.frame for residual in residuals]
    for label in ("before", "after"):
        axes[0].plot(names, [getattr(residual, f"loss_{label}") for residual in residuals], ".-", label=label)
        for panel, camera in zip(axes[1:], cameras, strict=True):
            scores = [getattr(residual, f"dice_{label}").get(camera, np.nan) for residual in residuals]
            panel.plot(names, scores, ".-", label=label)
            panel.set(ylabel=f"Dice, {camera}")
    axes[0].set(ylabel="loss")
    axes[0].legend(fontsize=8)
    axes[-1].set_xlabel("frame")
    axes[-1].tick_params(axis="x", rotation=90, labelsize=7)
    for panel in axes:
        panel.grid(alpha=0.3)
    return figure


def _unknowns_figure(result: CalibrationResult) -> "Figure":
    units = list(dict.fromkeys(unknown.unit for unknown in result.unknowns))
    figure = _figure(3.6 * len(units), 0.8 + 0.3 * len(result.unknowns))
    for panel, unit in zip(figure.subplots(1, len(units), squeeze=False)[0], units, strict=True):
        shown = [unknown for unknown in result.unknowns if unknown.unit == unit][::-1]
        panel.errorbar(
            [unknown.change for unknown in shown],
            [unknown.name for unknown in shown],
            xerr=[2 * unknown.standard_deviation for unknown in shown],
            fmt="o",
            capsize=3,
        )
        panel.axvline(0.0, color="black", linewidth=0.8)
        panel.set_xlabel(f"change [{unit}]")
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize=8)
    return figure


def _verdict(result: CalibrationResult) -> list[str]:
    found = result.assessment
    if found is None:
        return []
    return [f"Verdict: **{found.verdict.value}**. {found.reason} {found.remedy}".rstrip(), ""]


def _page(sequence: Sequence, result: CalibrationResult, residuals: Frames[FrameResidual]) -> str:
    cameras = _cameras(residuals)
    unchanged = not any(unknown.change for unknown in result.unknowns)
    which = "The calibration, as it was," if unchanged else "The new calibration"
    lines = [
        f"# Calibration of {in_markdown(sequence.name)}",
        "",
        f"From {counted(len(residuals), 'frame')}, joints as measured in all figures below. The optimization ended: "
        f"{result.stop_reason}. {which} is in `sequence.toml`, all numbers are in `calibration.json`.",
        "",
        *_verdict(result),
        "| mean over the frames | before | after |",
        "|---|---|---|",
        f"| loss | {result.frame_losses_before.mean():.4f} | {result.frame_losses_after.mean():.4f} |",
    ]
    for camera in cameras:
        if (means := mean_dice(residuals, camera)) is not None:
            lines.append(f"| Dice, {in_markdown(camera)} | {means[0]:.4f} | {means[1]:.4f} |")
    if moved := moved_frames(sequence.scene, result.scene):
        lines += ["", "| what moved | by [deg] | by [mm] |", "|---|---|---|"]
        lines += [f"| {in_markdown(name)} | {angle:.3f} | {distance:.3f} |" for name, angle, distance in moved]
    if (text := remark(sequence.scene, result)) is not None:
        lines += ["", f"**{in_markdown(text)}**"]
    lines += [
        "",
        "## Unknowns",
        "",
        "Base frames turn and shift in their own axes, cameras in theirs. The *standard deviation* allows for errors",
        "that frames share (of outlines, and 1 % of intrinsics that are held) and for how much the frames contradict",
        "each other, which *between frames* is alone. That *of the curvature* takes pixels for independent and is too",
        "small. An unknown whose deviation of the curvature is close to the prior's was not seen and stays where it",
        "was.",
        "",
        "![unknowns](unknowns.png)",
        "",
        "Bars are two standard deviations.",
        "",
        "| unknown | change | standard deviation | between frames | of the curvature | prior | unit |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {in_markdown(unknown.name)} | {unknown.change:.3f} | {unknown.standard_deviation:.3f} | "
        f"{'-' if unknown.deviation_between_frames is None else f'{unknown.deviation_between_frames:.3f}'} | "
        f"{unknown.deviation:.3f} | {unknown.prior_deviation:.3f} | {unknown.unit} |"
        for unknown in result.unknowns
    ]
    dice_columns = [f"Dice {in_markdown(camera)} {label}" for camera in cameras for label in ("before", "after")]
    columns = ["frame", "weight", "loss before", "loss after", *dice_columns]
    lines += ["", "## Frames", "", "![frames](frames.png)", ""]
    lines += [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for residual in residuals:
        scores = [
            f"{scores[camera]:.4f}" if camera in scores else "-"
            for camera in cameras
            for scores in (residual.dice_before, residual.dice_after)
        ]
        values = [f"{residual.weight:.2f}", f"{residual.loss_before:.4f}", f"{residual.loss_after:.4f}", *scores]
        lines.append(f"| {' | '.join([in_markdown(residual.frame), *values])} |")
    lines += ["", "A frame whose loss stands out from the others' counts less; its weight says how much.", ""]
    return "\n".join(lines)
