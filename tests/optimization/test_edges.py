"""Outlines drawn to edges: on images that a renderer made, and with the shipped networks on the shipped sequence."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float
from perfect_predictor import with_stage, without
from torch import Tensor
from torch.nn import functional

from carts_core.evaluation import dice, start_positions
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer, FreeParameters
from carts_core.optimization.factors import Linearization, Prior
from carts_core.optimization.image_factors import EdgeFactor, align_edges
from carts_core.optimization.variables import Variables
from carts_core.recording import Sequence
from carts_core.rendering import Outline, Renderer
from carts_core.resources import sample_sequence
from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import AlignEdges

ARM = "PSM1"
OFF = np.deg2rad([0.3, -0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Yaw and pitch move the outlines by one to two pixels."""


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=1, cameras=("left",), width=640, height=480))


@dataclass(frozen=True)
class Aligned:
    """Outlines on edges."""

    offsets: torch.Tensor
    edges: Linearization
    variables: Variables
    prior: Prior


def align(sequence: Sequence, image: np.ndarray | None = None, **given) -> Aligned:
    """Align from `OFF` the truth, knowing nothing else but that joints are right within 3 degrees."""
    frame = sequence.frame(0)
    images = frame.images if image is None else {"left": image}
    start = sequence.scene.state({ARM: (frame.truth or {})[ARM] + OFF})
    variables = Variables(sequence.scene, start, FreeParameters(), 0.15)
    seen = given.pop("seen", torch.ones(1, 360, 480))
    edges = EdgeFactor(
        sequence.scene,
        images,
        variables,
        given.pop("ignore", {}),
        SurfaceSolver(dehaze=given.pop("dehaze", 0.0)),
        seen.device,
    )
    prior, origin = variables.prior(SurfaceSolver(prior_deg=3.0)), torch.zeros(len(variables))
    stage = AlignEdges(steps=given.pop("steps", 20))
    return Aligned(*align_edges(edges, stage, origin, prior.linearize(origin), seen), variables, prior)


def test_outlines_come_to_lie_on_the_edges_of_the_image(sequence: Sequence) -> None:
    drawn = align(sequence)
    scene = sequence.scene
    renderer = Renderer(scene)
    truth = renderer.segment(scene.state(sequence.frame(0).truth or {}))[0] >= 0
    before, after = (
        dice(renderer.segment(drawn.variables.state(offsets))[0] >= 0, truth)
        for offsets in (torch.zeros_like(drawn.offsets), drawn.offsets)
    )
    assert 1.0 - after < 0.3 * (1.0 - before)
    # What pulls at the end is held by what was known before.
    held = drawn.prior.gradient(drawn.offsets)
    pulled = (drawn.edges.gradient.abs() + held.abs()).max()
    assert (drawn.edges.gradient + held).abs().max() < 0.1 * pulled


def test_where_there_is_no_edge_nothing_moves(sequence: Sequence) -> None:
    drawn = align(sequence, np.full((480, 640, 3), 128, np.uint8))
    assert drawn.offsets.abs().max() == 0
    assert drawn.edges.hessian.abs().max() == 0


def test_edges_of_an_occluder_do_not_count(sequence: Sequence) -> None:
    drawn = align(sequence, ignore={"left": np.ones((480, 640), bool)})
    assert drawn.offsets.abs().max() == 0


def test_edges_are_weighted_by_squared_transmission(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.optimization.image_factors.dehazed", lambda images, _: images)
    found = []
    for through in (1.0, 0.5):
        monkeypatch.setattr(
            "carts_core.optimization.image_factors.transmission",
            lambda images, _, t=through: t * torch.ones_like(images[:, :1]),
        )
        found.append(align(sequence, steps=1, dehaze=0.8).edges.hessian)
    clear, hazy = found
    assert clear.abs().max() > 0
    torch.testing.assert_close(hazy, 0.25 * clear)


@pytest.mark.parametrize(
    "domain", ["smoke", *(pytest.param(name, marks=pytest.mark.slow) for name in ("regular", "bleeding"))]
)
def test_edges_bring_masks_nearer_to_the_truth(domain: str) -> None:
    """On two frames of the shipped sequence, 2 degrees off."""
    sequence, extractor = Sequence.open(sample_sequence()), FeatureExtractor.load()
    camera = sequence.scene.cameras[0].name
    scene = sequence.scene.with_cameras([camera])
    renderer = Renderer(scene)
    found: dict[int, list[float]] = {0: [], 8: []}
    for index in (6, 18):
        frame = sequence.frame(index, domain, [camera])
        start = start_positions(sequence, frame, 2.0, 0)
        for steps, dices in found.items():
            settings = with_stage(AlignEdges, steps=steps) if steps else without(AlignEdges)
            optimizer = FrameOptimizer(scene, frame, {}, extractor, start=start, settings=settings, live=False)
            list(optimizer)
            assert optimizer.best is not None and frame.masks is not None
            dices.append(dice(renderer.segment(optimizer.best.state)[0] >= 0, frame.masks[camera]))
    assert np.mean(found[8]) > np.mean(found[0]) + 0.001


def nearest_ref(edges: EdgeFactor, outline: Outline) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
    """See `EdgeFactor._nearest`."""
    strength = _strength_ref(edges, outline) * edges._expected[:, None]
    best, last = strength.argmax(0), len(edges._samples) - 1
    middle = best.clamp(1, last - 1)
    before, peak, after = (strength.gather(0, (middle + d)[None])[0] for d in (-1, 0, 1))
    finer = 0.5 * (after - before) / (2.0 * peak - before - after).clamp(min=1e-12)
    # The strongest one at either end is the flank of an edge further away.
    found = (best > 0) & (best < last)
    return edges._samples[middle] + 0.5 * finer.clamp(-0.5, 0.5), found.to(strength)


def _strength_ref(edges: EdgeFactor, outline: Outline) -> Float[Tensor, "samples K"]:
    """Squared change of colour along the normal."""
    height, width = edges._gradient.shape[2:]
    scale = 2.0 / (torch.tensor([width, height])[:, None] - 1.0)
    where = outline.position[:, None] + outline.normal[:, None] * edges._samples[:, None]
    grid = (where * scale[..., None] - 1.0).movedim(0, -1)
    strength = torch.zeros_like(where[0])
    for index, gradient in enumerate(edges._gradient):
        here = outline.camera == index
        right, down = functional.grid_sample(gradient[None], grid[:, here][None], align_corners=True)[0].split(3)
        normal = outline.normal[:, here]
        strength[:, here] = (right * normal[0] + down * normal[1]).square().sum(0)
    return strength


def test_the_compiled_kernel_finds_the_same_edges_as_torch(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    start = sequence.scene.state({ARM: (frame.truth or {})[ARM] + OFF})
    variables = Variables(sequence.scene, start, FreeParameters(), 0.15)
    device = torch.device("cpu")
    edges = EdgeFactor(sequence.scene, frame.images, variables, {}, SurfaceSolver(dehaze=0.0), device)
    outline = edges.near(torch.zeros(len(variables)), torch.ones(1, 360, 480), 0.3)._outline
    compiled, plain = edges._nearest(outline), nearest_ref(edges, outline)
    assert len(outline.camera) > 500 and 0.2 < float(plain[1].mean()) < 1.0
    # Where two edges are as strong but for the last bits, either may be found.
    same = (compiled[0] - plain[0]).abs() < 1e-3
    assert float(same.float().mean()) > 0.99 and torch.equal(compiled[1][same], plain[1][same])
