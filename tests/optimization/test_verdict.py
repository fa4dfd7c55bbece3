"""Verdicts on frames, sequences and calibrations, and domain checks."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evidence import CONVINCING
from tiny import tiny_scene

from carts_core.cli.printing import calibration_hint, sequence_hint, verdict_hints, verdict_line
from carts_core.evaluation import evaluate
from carts_core.imaging.working_image import Window
from carts_core.model.parts import COVERAGE
from carts_core.model.robot import Robot
from carts_core.model.scene import SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import (
    Assessment,
    DomainCheck,
    Evidence,
    FrameOptimizer,
    FreeParameters,
    ImagePredictor,
    MaskPredictor,
    StopReason,
    SurfaceSolver,
    Verdict,
    check_domain,
)
from carts_core.optimization.observation import FrameImages
from carts_core.optimization.results import Uncertainty
from carts_core.optimization.verdict import (
    MIN_ARM_AREA,
    assess,
    assess_calibration,
    assess_sequence,
    evidence,
    median_evidence,
    without_knowledge,
    worse_in,
)
from carts_core.recording import Sequence
from carts_core.rendering import Renderer

CONTRADICTED = replace(
    CONVINCING,
    loss=0.2,
    residual=0.8,
    agreement=0.4,
    unconditioned=0.1,
    predicted=0.1,
    changed=0.2,
    overlap_with_change=0.1,
)


@pytest.fixture(scope="module")
def extractor() -> FeatureExtractor:
    return FeatureExtractor.load()


@pytest.fixture(scope="module")
def shipped(sample_sequence_path: Path) -> Sequence:
    return Sequence.open(sample_sequence_path)


def _unknown_background(found: Evidence) -> Evidence:
    return replace(found, changed=None, overlap_with_change=None)


@pytest.mark.parametrize("of", [lambda found: found, _unknown_background])
def test_what_all_evidence_supports_is_good_and_what_it_contradicts_has_failed(of: Callable[..., Evidence]) -> None:
    good, bad = assess(of(CONVINCING)), assess(of(CONTRADICTED))
    assert good.verdict is Verdict.GOOD and good.remedy == "" and good.probability < 0.1
    assert bad.verdict is Verdict.FAILED and bad.remedy and bad.probability > 0.5


def test_no_arm_in_view_is_said_whatever_else_speaks_for_the_fit() -> None:
    found = assess(replace(CONVINCING, start_area=0.0))
    assert found.verdict is Verdict.FAILED and found.nothing_there
    assert found.reason.startswith("No arm is in view") and "T_camera_world" in found.remedy


def test_an_image_like_the_empty_background_shows_no_arm() -> None:
    found = assess(replace(CONVINCING, changed=0.0, overlap_with_change=0.0))
    assert found.verdict is Verdict.FAILED and found.nothing_there and "empty background" in found.reason


def test_a_mask_that_is_black_on_the_arms_or_shows_none_has_failed() -> None:
    masked = replace(CONVINCING, masked=True, agreement=1.0, changed=None, overlap_with_change=None)
    assert assess(masked).verdict is Verdict.GOOD and "mask" in assess(masked).reason
    assert assess(replace(masked, area=0.45, start_area=0.01)).verdict is Verdict.GOOD
    assert assess(replace(masked, area=0.7, start_area=0.6)).verdict is Verdict.GOOD
    inverted = assess(replace(masked, area=0.9, start_area=0.15))
    assert inverted.verdict is Verdict.FAILED and inverted.nothing_there and "not inverted" in inverted.remedy
    assert assess(replace(masked, start_area=0.0)).verdict is Verdict.GOOD
    assert assess(replace(masked, start_area=0.0, area=0.0)).reason.startswith("No arm is in view")
    empty = assess(replace(masked, agreement=0.0, predicted=0.0))
    assert empty.verdict is Verdict.FAILED and empty.reason.startswith("The given mask is empty")


@pytest.mark.parametrize(("predicted", "wanted"), [(0.7, Verdict.GOOD), (0.05, Verdict.DOUBTFUL)])
def test_a_fit_whose_wrist_or_jaws_are_not_predicted_is_not_good(predicted: float, wanted: Verdict) -> None:
    found = assess(replace(CONVINCING, parts_predicted=predicted))
    assert found.verdict is wanted and ("wrist or jaws" in found.reason) == (wanted is Verdict.DOUBTFUL)


_HARDLY = {"loss": 0.033, "residual": 0.101, "agreement": 0.900, "unconditioned": 0.700, "overlap_with_change": 0.770}
_WRONG = {"loss": 0.056, "residual": 0.228, "agreement": 0.846, "unconditioned": 0.791, "overlap_with_change": 0.772}


@pytest.mark.parametrize(
    ("seen", "wanted"),
    [
        (_HARDLY, Verdict.GOOD),
        ({**_HARDLY, "loss": 0.046, "residual": 0.085, "agreement": 0.922, "overlap_with_change": None}, Verdict.GOOD),
        (_WRONG, Verdict.DOUBTFUL),
        (
            {**_WRONG, "loss": 0.067, "residual": 0.248, "agreement": 0.841, "overlap_with_change": None},
            Verdict.DOUBTFUL,
        ),
    ],
    ids=["Dice .988", "Dice .990, smoke", "Dice .882", "Dice .892, smoke"],
)
def test_wrong_fits_of_unknown_instruments_are_doubtful(seen: dict[str, float | None], wanted: Verdict) -> None:
    found = assess(replace(CONVINCING, **seen))
    assert found.verdict is wanted and Verdict.of(found.probability) is wanted


@pytest.mark.parametrize(("overlap", "wanted"), [(0.89, Verdict.DOUBTFUL), (0.91, Verdict.GOOD)])
def test_a_fit_to_a_mask_is_good_from_a_dice_of_nine_tenths(overlap: float, wanted: Verdict) -> None:
    masked = replace(CONVINCING, masked=True, agreement=overlap, changed=None, overlap_with_change=None)
    assert assess(masked).verdict is wanted and Verdict.of(assess(masked).probability) is wanted


def test_a_verdict_grows_worse_with_the_evidence() -> None:
    order = [Verdict.GOOD, Verdict.DOUBTFUL, Verdict.FAILED]
    names = ("loss", "residual", "agreement", "unconditioned", "predicted", "changed", "overlap_with_change")
    levels = []
    for share in np.linspace(0.0, 1.0, 21):
        mixed = {n: (1 - share) * getattr(CONVINCING, n) + share * getattr(CONTRADICTED, n) for n in names}
        levels.append(order.index(assess(replace(CONVINCING, **mixed)).verdict))
    assert levels == sorted(levels) and set(levels) == {0, 1, 2}


def test_a_doubtful_fit_widens_the_deviations_and_of_a_failed_one_the_expected_ones_are_left() -> None:
    known = Uncertainty(("PSM1/yaw", "PSM1/jaw"), (0.01, 0.04), (0.05, 0.05))
    half = replace(assess(CONVINCING), verdict=Verdict.DOUBTFUL, probability=0.36)
    assert assess(CONVINCING).of(known) == known
    np.testing.assert_allclose(half.of(known).std, np.sqrt([0.64 * 0.01**2 + 0.36 * 0.05**2, 0.64 * 0.04**2 + 9e-4]))
    assert assess(CONTRADICTED).of(known).std == pytest.approx(known.expected)


@pytest.mark.parametrize("shown", ["black", pytest.param("background", marks=pytest.mark.slow)])
def test_without_an_arm_in_view_the_frame_fails(shipped: Sequence, extractor: FeatureExtractor, shown: str) -> None:
    frame, scene = shipped.frame(0, cameras=["left"]), shipped.scene.with_cameras(["left"])
    empty = shipped.background("left")
    image = np.zeros_like(empty) if shown == "black" else empty
    optimizer = FrameOptimizer(scene, replace(frame, images={"left": image}), {"left": empty}, extractor, live=False)
    list(optimizer)
    found = optimizer.assessment
    assert found is not None and found.verdict is Verdict.FAILED and found.reason and found.remedy
    assert optimizer.best is not None and optimizer.best.uncertainty is not None
    assert optimizer.best.uncertainty.std == pytest.approx(optimizer.best.uncertainty.expected)
    for arm, joints in optimizer.best.joint_positions().items():
        assert np.allclose(joints, frame.measured[arm], atol=1e-6)


def test_an_arm_behind_the_camera_is_said_to_be_out_of_view(shipped: Sequence, extractor: FeatureExtractor) -> None:
    (camera,) = shipped.scene.with_cameras(["left"]).cameras
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.T_camera_world
    scene = replace(shipped.scene, cameras=(replace(camera, T_camera_world=turned),))
    frame = shipped.frame(0, cameras=["left"])
    optimizer = FrameOptimizer(scene, frame, {}, extractor, live=False)
    list(optimizer)
    assert optimizer.assessment is not None and optimizer.assessment.reason.startswith("No arm is in view")
    assert optimizer.best is not None
    assert all(np.allclose(q, frame.measured[arm], atol=1e-6) for arm, q in optimizer.best.joint_positions().items())


def test_a_clear_frame_is_good_and_the_evaluation_says_so(shipped: Sequence, extractor: FeatureExtractor) -> None:
    (score,) = evaluate(
        shipped,
        extractor,
        frames=[4],
        cameras=["left"],
        domains=["regular"],
        settings=SurfaceSolver(),
        free=FreeParameters(),
        perturb_deg=1.0,
    )
    assert score.verdict == "good" and score.reason == "The image supports the fit."


def test_hints_name_frames_reasons_and_what_to_try() -> None:
    failed = assess(replace(CONVINCING, start_area=0.0))
    (hint,) = verdict_hints("left", {"001": failed, "002": assess(CONVINCING), "003": failed, "004": None})
    assert hint == f"left: failed in 2 of 4 frames (001, 003). {failed.reason} {failed.remedy}"
    assert verdict_hints("left", {"002": assess(CONVINCING)}) == []


def test_a_hidden_arm_is_in_view(shipped_psm: Robot, tiny_sequence: Callable[..., Path]) -> None:
    tiny = tiny_scene(shipped_psm, 3, ("left",), 320, 240)
    camera, arm = tiny.scene.cameras[0], tiny.scene.arms[0]
    scene = replace(tiny.scene, arms=(arm, replace(arm, name="PSM2")))
    joints = {name: tiny.truth[0] for name in ("PSM1", "PSM2")}

    def beside(sideways: float, behind: float) -> SceneState:
        """The second arm beside and behind the first one, as the camera sees it [m]."""
        T_world_base = np.stack([arm.T_world_base, arm.T_world_base])
        T_world_base[1, :3, 3] += camera.T_camera_world[:3, :3].T @ [sideways, 0.0, behind]
        return replace(scene.state(joints), T_world_base=torch.from_numpy(T_world_base).float())

    mask = Renderer(scene).segment(beside(0.0, 0.004))[0] >= 0
    frame = replace(Sequence.open(tiny_sequence(frames=1, width=320, height=240)).frame(0), masks={"left": mask})
    predictor = MaskPredictor().for_frame(frame, ["left"])
    images = FrameImages.of(scene, frame.images, {}, SurfaceSolver(dehaze=0.0), predictor)
    start = beside(0.02, 0.004)
    hidden, gone = (evidence(images, start, end, predictor, 0.01) for end in (beside(0.0, 0.004), beside(0.2, 0.004)))
    assert hidden.still_in_view > 0.7 and "left the image" not in assess(hidden).reason
    assert gone.still_in_view < 0.3 and "left the image" in assess(gone).reason


class _FirstArm(ImagePredictor):
    """Predicts the coverage of one state, whatever the image."""

    device, stride = torch.device("cpu"), 8

    def __init__(self, coverage: torch.Tensor) -> None:
        self._coverage = coverage

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        maps = window.of(given).clone()
        maps[:, COVERAGE] = window.of(self._coverage[: len(given)])
        return maps


def test_small_arms_are_assessed_per_camera(shipped_psm: Robot, tiny_sequence: Callable[..., Path]) -> None:
    tiny = tiny_scene(shipped_psm, 3, ("left",), 320, 240)
    camera, arm = tiny.scene.cameras[0], tiny.scene.arms[0]
    frame = Sequence.open(tiny_sequence(frames=1, width=320, height=240)).frame(0)
    found = []
    for names in (("left",), ("left", "right")):
        scene = replace(
            tiny.scene,
            arms=(arm, replace(arm, name="PSM2")),
            cameras=tuple(replace(camera, name=name) for name in names),
        )
        T_world_base = torch.from_numpy(np.stack([arm.T_world_base, arm.T_world_base])).float()
        # Far away, the second arm covers a share of the images between half of the least one that counts, and it.
        T_world_base[1, :3, 3] += torch.from_numpy(camera.T_camera_world[:3, :3].T @ [1.0, 0.0, 2.7]).float()
        state = replace(scene.state({name: tiny.truth[0] for name in ("PSM1", "PSM2")}), T_world_base=T_world_base)
        share = float((Renderer(scene).segment(state) == 1).mean())
        assert MIN_ARM_AREA / 2 < share < MIN_ARM_AREA
        predictor = _FirstArm(torch.zeros(2, 4, 240, 320))
        images = FrameImages.of(scene, {name: frame.images["left"] for name in names}, {}, SurfaceSolver(), predictor)
        alone = images.renderer.surface_maps(replace(state, T_world_base=torch.stack([T_world_base[0]] * 2)))
        found.append(evidence(images, state, state, _FirstArm(alone[:, COVERAGE]), 0.01))
        # An arm of which so little is in view may leave the image.
        gone = T_world_base.clone()
        gone[1, :3, 3] += torch.from_numpy(camera.T_camera_world[:3, :3].T @ [9.0, 0.0, 0.0]).float()
        left = evidence(images, state, replace(state, T_world_base=gone), _FirstArm(alone[:, COVERAGE]), 0.01)
        assert left.still_in_view == 1.0
    one, two = found
    assert one.agreement > 0.8 and two.agreement == pytest.approx(one.agreement, abs=1e-3)


RIGHT = replace(CONVINCING, changed=None, overlap_with_change=None)
WRONG = replace(RIGHT, loss=0.2, residual=0.8, agreement=0.4, unconditioned=0.1, predicted=0.1)


def verdicts(right: int, wrong: int) -> list[Assessment]:
    return [assess(RIGHT)] * right + [assess(WRONG)] * wrong


@pytest.mark.parametrize(
    ("right", "wrong", "wanted"),
    [(20, 0, Verdict.GOOD), (19, 1, Verdict.GOOD), (15, 5, Verdict.DOUBTFUL), (10, 10, Verdict.FAILED)],
)
def test_a_sequence_is_as_good_as_most_of_its_frames(right: int, wrong: int, wanted: Verdict) -> None:
    found = assess_sequence(verdicts(right, wrong))
    assert found.verdict is wanted and found.counts == {"good": right, "doubtful": 0, "failed": wrong}
    assert (sequence_hint("left", found) is None) == (wanted is Verdict.GOOD)


def test_frames_without_arms_say_nothing_about_the_others() -> None:
    absent = assess(replace(RIGHT, start_area=0.0, area=0.0))
    found = assess_sequence([absent] * 8 + verdicts(4, 0))
    assert found.verdict is Verdict.GOOD and found.counts == {"good": 4, "doubtful": 0, "failed": 8}
    assert assess_sequence([absent] * 8 + verdicts(1, 3)).verdict is Verdict.FAILED
    assert assess_sequence([absent] * 8).verdict is Verdict.FAILED
    elsewhere = assess(replace(absent.evidence, elsewhere=0.1))
    assert assess_sequence([elsewhere] * 8 + verdicts(4, 0)).verdict is Verdict.FAILED


def test_the_verdict_on_a_sequence_names_the_reason_of_most_frames_and_what_to_try() -> None:
    unseen = assess(replace(RIGHT, start_area=0.0))
    found = assess_sequence([unseen] * 3 + verdicts(2, 1))
    assert unseen.reason in found.reason and found.remedy == unseen.remedy
    hint = sequence_hint("left", found)
    assert hint is not None and "keep the measured values" in hint


def test_a_calibration_is_judged_by_the_median_of_its_frames() -> None:
    good, failed = assess_calibration([RIGHT] * 5), assess_calibration([WRONG] * 5)
    assert good.verdict is Verdict.GOOD and good.reason == "The images support the calibration."
    assert failed.verdict is Verdict.FAILED and "calibration" in failed.reason and "--observe masks" in failed.remedy
    assert "calibration was not changed" in (calibration_hint(failed, StopReason.FAILED) or "")
    assert median_evidence([RIGHT, WRONG]).agreement == pytest.approx(0.675)


def test_a_doubtful_calibration_fails_where_the_network_does_not_know_the_robot() -> None:
    doubtful = Assessment(Verdict.DOUBTFUL, "The edges do not agree.", "Look at it.", 0.3, RIGHT)
    stranger, friend, unseen = (DomainCheck(recognized=value, elsewhere=0.0) for value in (0.9, 0.97, None))
    found = without_knowledge(doubtful, [stranger, unseen, stranger])
    assert found.verdict is Verdict.FAILED and "The edges do not agree, and the network's prediction" in found.reason
    assert "overlap of only 0.90" in found.reason and "--observe masks" in found.remedy
    hardly = without_knowledge(doubtful, [replace(stranger, recognized=0.9499)])
    assert "an overlap of only 0.949 (0.95 or more is usual)" in hardly.reason
    assert without_knowledge(doubtful, [friend, friend, stranger]) == doubtful
    assert without_knowledge(doubtful, [unseen]) == doubtful and without_knowledge(doubtful, []) == doubtful
    good = assess_calibration([RIGHT] * 5)
    assert without_knowledge(good, [stranger]) == good


def test_what_is_worse_beyond_chance_is_named() -> None:
    before = [replace(RIGHT, agreement=0.95 + 0.001 * i) for i in range(6)]
    assert worse_in(before, before) == []
    lower = [replace(found, agreement=found.agreement - 0.01) for found in before]
    assert worse_in(before, lower) == ["agreement"] and worse_in(lower, before) == []
    uneven = [replace(f, residual=f.residual + (0.3 if i == 0 else -0.05)) for i, f in enumerate(before)]
    assert worse_in(before, uneven) == []


@pytest.mark.parametrize(("drop", "wanted"), [(1e-5, []), (0.005, []), (0.1, ["agreement"])])
def test_one_frame_is_worse_by_more_than_frames_usually_differ(drop: float, wanted: list[str]) -> None:
    assert worse_in([RIGHT], [replace(RIGHT, agreement=RIGHT.agreement - drop)]) == wanted


def test_five_measures_together_are_called_worse_by_chance_once_in_twenty() -> None:
    random, names = np.random.default_rng(0), ("agreement", "unconditioned", "overlap_with_change", "residual", "loss")
    known, wrong = replace(CONVINCING), 0
    for _ in range(400):
        changes = 0.02 * random.standard_normal((20, len(names)))
        after = [
            replace(known, **{name: getattr(known, name) + step for name, step in zip(names, row, strict=True)})
            for row in changes
        ]
        wrong += bool(worse_in([known] * len(after), after))
    assert wrong / 400 < 0.07


def test_verdicts_on_masks_are_counted_with_the_joints_that_are_not_determined() -> None:
    assert verdict_line("left", [None], [None]) is None
    joints = [["PSM1.roll", "PSM1.jaw"], None, ["PSM1.roll", "PSM1.jaw"], [], None]
    said = verdict_line("left", ["good", "failed", "good", "good", None], joints)
    assert said == (
        "left: mask good, 2 joints not determined in 2 of 4 runs; mask good, all joints determined in 1 of 4 runs; "
        "mask failed in 1 of 4 runs."
    )


class SeesArmsEverywhere(ImagePredictor):
    """Takes all of every image for arms."""

    device, stride = torch.device("cpu"), 16

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """See the class."""
        found = torch.zeros_like(given)
        found[:, 0] = 1.0
        return window.of(found)


def test_the_shipped_network_knows_the_shipped_recording(shipped: Sequence) -> None:
    found = check_domain(
        shipped.scene.with_cameras(["left"]), shipped.frame(3, cameras=["left"]), FeatureExtractor.load()
    )
    assert found.recognized is not None and found.recognized > 0.95 and found.elsewhere < 0.05
    assert found.warnings("left") == []


def test_a_network_that_knows_nothing_is_told_of_with_remedies(shipped: Sequence) -> None:
    found = check_domain(shipped.scene.with_cameras(["left"]), shipped.frame(3, cameras=["left"]), SeesArmsEverywhere())
    robot, image = found.warnings("left")
    assert "prediction on a rendering" in robot and "--observe masks" in robot and "carts train" in robot
    assert "% of the image" in image and "--observe masks" in image
    assert found.warnings("left", background=True) == [robot]
