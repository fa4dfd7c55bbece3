"""Outlines are aligned with colours and edges of an image, without a network."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor

from carts_core.errors import SettingsError
from carts_core.evaluation import dice
from carts_core.networks import FeatureExtractor
from carts_core.optimization import SequenceOptimizer, Verdict
from carts_core.optimization.factors import Prior
from carts_core.optimization.regions import Alignment, ColourModel, RegionFactor, RegionImages, align_regions
from carts_core.optimization.sequence_frame import SequenceFrameSolver
from carts_core.optimization.variables import Variables
from carts_core.optimization.verdict import Evidence
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from carts_core.settings import FreeParameters, SequenceSettings, SurfaceSolver
from carts_core.settings.stages import AlignRegions

SETTINGS, STAGE, OFF = SurfaceSolver(), AlignRegions(), np.deg2rad(0.2)


@pytest.fixture(scope="module")
def sample() -> Sequence:
    return Sequence.open(sample_sequence())


def learnt(sample: Sequence, index: int) -> ColourModel:
    frame = sample.frame(index)
    found = RegionImages(sample.scene, frame.images, {}, SETTINGS).learnt(sample.scene.state(frame.truth or {}))
    assert found is not None
    return found


def aligned(sample: Sequence, frame: Frame, colours: ColourModel) -> tuple[Variables, torch.Tensor, Alignment]:
    """Alignment from joints that are off, with their errors as prior."""
    variables = Variables(sample.scene, sample.scene.state(frame.truth or {}), FreeParameters(), SETTINGS.length_scale)
    start = torch.from_numpy(np.random.default_rng(0).normal(0, OFF, len(variables)).astype(np.float32))
    prior = Prior(start, torch.eye(len(variables)) / OFF**2)
    factor = RegionFactor(RegionImages(sample.scene, frame.images, {}, SETTINGS), variables, colours, STAGE)
    return variables, start, align_regions(factor, prior.linearize(start), STAGE, start, variables)


def test_outlines_move_to_the_arms(sample: Sequence) -> None:
    frame, renderer = sample.frame(4), Renderer(sample.scene)
    variables, start, found = aligned(sample, frame, learnt(sample, 3))
    assert frame.masks is not None
    before, after = (
        dice(renderer.segment(variables.state(at))[0] >= 0, frame.masks["left"]) for at in (start, found.offsets)
    )
    assert before < 0.98 and after > 0.985
    assert (found.likelihood > 0.4).all() and (torch.linalg.eigvalsh(found.model.hessian) > -1.0).all()


def test_the_likelihood_of_a_hidden_arm_is_low(sample: Sequence) -> None:
    frame, colours = sample.frame(4), learnt(sample, 3)
    image = frame.images["left"].copy()
    image[:, :320] = image[240, 320]
    _, _, found = aligned(sample, replace(frame, images={"left": image}), colours)
    assert found.likelihood.min() < 0.2 and found.likelihood.max() > 0.4


def test_no_colours_are_learnt_in_smoke(sample: Sequence) -> None:
    frame = sample.frame(4, "smoke")
    assert RegionImages(sample.scene, frame.images, {}, SETTINGS).learnt(sample.scene.state(frame.truth or {})) is None


def test_smoke_lowers_the_likelihood(sample: Sequence) -> None:
    clear, smoke = (
        aligned(sample, sample.frame(4, domain), learnt(sample, 3))[2].likelihood.min()
        for domain in ("regular", "smoke")
    )
    assert smoke < 0.25 and clear > 0.4


def test_ignored_pixels_and_missing_images(sample: Sequence) -> None:
    frame = sample.frame(4)
    everything = {"left": np.ones(frame.images["left"].shape[:2], bool)}
    assert not RegionImages(sample.scene, frame.images, everything, SETTINGS).shown.any()
    with pytest.raises(SettingsError, match="the image of camera 'left' is missing"):
        RegionImages(sample.scene, {}, {}, SETTINGS)


def test_no_colours_are_learnt_from_a_missing_image(sample: Sequence) -> None:
    frame = replace(sample.frame(4), missing=("left",))
    predictor = PerfectPredictor(sample, sample.scene.state(frame.truth or {}))
    solver = SequenceFrameSolver(sample.scene, predictor, SETTINGS, SequenceSettings(), lambda _: {})
    variables = Variables(sample.scene, sample.scene.state(frame.truth or {}), FreeParameters(), SETTINGS.length_scale)
    found = solver.colours(frame, variables, np.zeros(len(variables)))
    assert found is not None and found.counts.sum() == 0


@pytest.mark.parametrize("convincing", [True, False])
def test_routine_frames_get_verdicts_of_good_neighbours(monkeypatch: pytest.MonkeyPatch, convincing: bool) -> None:
    shipped, model, assessed = Sequence.open(sample_sequence()), SequenceSettings(look_every=2, assess_every=4), []
    usual = SequenceFrameSolver.evidence

    def evidence(self: SequenceFrameSolver, frame: Frame, *arguments) -> Evidence:
        assessed.append(frame.index)
        found = usual(self, frame, *arguments)
        return found if convincing or frame.index else replace(found, loss=1.0)

    monkeypatch.setattr(SequenceFrameSolver, "evidence", evidence)
    optimizer = SequenceOptimizer(
        shipped.scene, shipped.frame, dict.fromkeys(range(12)), FeatureExtractor.load(), model=model
    )
    list(optimizer)
    looked = [index for index, visit in sorted(optimizer._visits.items()) if not visit.measurement.by_colours]
    verdicts = [one.assessment and one.assessment.verdict for one in optimizer.estimates.values()]
    assert len(looked) > 5 and all(verdict is not None for verdict in verdicts)
    if convincing:
        assert set(assessed) < set(looked) and np.diff(sorted(assessed)).max() <= 5
        assert set(verdicts) == {Verdict.GOOD}
    else:
        # The neighbours of the first, failed frame are assessed themselves.
        assert {0, 1, 2} <= set(assessed)
