"""The training report: curves, example predictions and a page that shows both."""

import json
from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn import functional

from .checkpoint import History
from .network import FeatureNetwork

matplotlib.use("Agg")

_EXAMPLES = 6
_TERMS = ("cross_entropy", "dice", "consistency", "parts")


def write_report(
    folder: Path,
    config_json: str,
    history: History,
    network: FeatureNetwork,
    images: Float[Tensor, "pairs 2 3 h w"],
    classes: Int[Tensor, "pairs 2 h w"],
) -> Path:
    """Write `curves.png`, `predictions.jpg` and `README.md`; returns the path of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    _curves(history).savefig(folder / "curves.png", dpi=110)
    _predictions(network, images, classes).savefig(folder / "predictions.jpg", dpi=110, pil_kwargs={"quality": 85})
    page = folder / "README.md"
    page.write_text(_page(json.loads(config_json), history, network), encoding="utf-8")
    return page


def _curves(history: History) -> Figure:
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    loss_axes, dice_axes, similarity_axes = figure.subplots(1, 3)
    steps = [entry["step"] for entry in history.losses]
    for name in _TERMS:
        loss_axes.plot(steps, [entry[name] for entry in history.losses], label=name.replace("_", " "), linewidth=0.9)
    loss_axes.set(title="training loss, per term", xlabel="step", yscale="log")
    steps = [entry["step"] for entry in history.validations]
    for name in ("dice_observed", "dice_hybrid"):
        dice_axes.plot(steps, [entry[name] for entry in history.validations], ".-", label=name.removeprefix("dice_"))
    dice_axes.set(title="validation: Dice of the network's mask", xlabel="step")
    for name in ("similarity_aligned", "similarity_misaligned"):
        values = [entry[name] for entry in history.validations]
        similarity_axes.plot(steps, values, ".-", label=name.removeprefix("similarity_"))
    similarity_axes.set(title="validation: cosine, observed to hybrid", xlabel="step")
    for axes in (loss_axes, dice_axes, similarity_axes):
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend(fontsize=8)
    return figure


@torch.no_grad()
def _predictions(network: FeatureNetwork, images: Tensor, classes: Tensor) -> Figure:
    folded = network.folded()
    count = min(_EXAMPLES, len(images))
    titles = ("observed", "its prediction", "hybrid", "its prediction", "cosine of features")
    figure = Figure(figsize=(11, 1.75 * count), layout="constrained")
    rows = figure.subplots(count, len(titles), squeeze=False)
    for row, pair, truth in zip(rows, images[:count], classes[:count], strict=True):
        features = folded.features(pair.to(next(folded.parameters()).device))
        predicted = (folded.head(features)[:, 0] > 0).cpu().numpy()
        similarity = functional.cosine_similarity(features[:1], features[1:], dim=1)[0].cpu().numpy()
        shown = pair.permute(0, 2, 3, 1).numpy()
        mask = (truth > 0).numpy()
        panels = (shown[0], _confusion(predicted[0], mask[0]), shown[1], _confusion(predicted[1], mask[1]), similarity)
        for axes, panel in zip(row, panels, strict=True):
            axes.imshow(panel, vmin=-1 if panel.ndim == 2 else None, vmax=1 if panel.ndim == 2 else None, cmap="RdYlGn")
            axes.set_axis_off()
    for axes, title in zip(rows[0], titles, strict=True):
        axes.set_title(title, fontsize=9)
    return figure


def _confusion(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """True positives white, true negatives black, false positives orange, false negatives red, as in the paper."""
    image = np.zeros((*truth.shape, 3))
    image[predicted & truth] = 1, 1, 1
    image[predicted & ~truth] = 1, 0.6, 0.1
    image[~predicted & truth] = 0.9, 0.1, 0.1
    return image


def _page(config: dict, history: History, network: FeatureNetwork) -> str:
    parameters = sum(parameter.numel() for parameter in network.parameters())
    lines = [
        "# Training report",
        "",
        f"{config['steps']} steps of {config['batch_pairs']} pairs, {history.seconds / 60:.0f} minutes, "
        f"{parameters:,} parameters, robots: {', '.join(config['robots'])}.",
        "",
        "![curves](curves.png)",
        "",
        "| step | Dice, observed | Dice, hybrid | cosine, aligned | cosine, misaligned |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {entry['step']} | {entry['dice_observed']:.4f} | {entry['dice_hybrid']:.4f} "
        f"| {entry['similarity_aligned']:.3f} | {entry['similarity_misaligned']:.3f} |"
        for entry in history.validations
    ]
    lines += [
        "",
        "Validation images are made like the training images, from random numbers that training never sees.",
        "",
        "White: true positives. Black: true negatives. Orange: false positives. Red: false negatives.",
        "",
        "![example predictions](predictions.jpg)",
        "",
        "## Settings",
        "",
        "```json",
        json.dumps(config, indent=2),
        "```",
        "",
    ]
    return "\n".join(lines)
