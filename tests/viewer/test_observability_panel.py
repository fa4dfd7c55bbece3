"""What the optimizer's panel says about joints that the image does not determine, and about base frames."""

from dataclasses import replace
from types import SimpleNamespace

from carts_core.optimization import BASE_FRAME_GAIN
from carts_core.optimization.observability import Uncertainty
from carts_viewer.choices import JointRange
from carts_viewer.panels.optimize import undetermined_lines
from carts_viewer.panels.sequence import calibration_line
from carts_viewer.state import Maps, Phase, RunState


def _state(uncertainty: Uncertainty | None, phase: Phase) -> SimpleNamespace:
    iterate = SimpleNamespace(uncertainty=uncertainty)
    start, end = (SimpleNamespace(jaw=value) for value in (0.1, 0.12))
    run = replace(RunState(), phase=phase, start=start)
    return SimpleNamespace(maps=Maps(iterate, ("left",)), run=run, pose=SimpleNamespace(scene=end))  # pyright: ignore


SESSION = SimpleNamespace(
    ranges={"PSM1": (JointRange("PSM1", "jaw", True, -1.0, 1.0),)}, joints=lambda scene: {"PSM1": [scene.jaw]}
)


KNOWN = Uncertainty(("PSM1/outer_yaw", "PSM1/wrist_yaw", "PSM1/jaw"), (0.01, 0.03, 0.05), (0.05, 0.05, 0.05))


def test_joints_that_the_image_leaves_open_are_named_by_how_much() -> None:
    lines = undetermined_lines(_state(KNOWN, Phase.IDLE), SESSION)  # pyright: ignore
    assert "Weakly determined by this image: PSM1 wrist yaw<" in lines
    assert "Not determined by this image: PSM1 jaw (moved by +1.1°)<" in lines
    assert "outer" not in lines


def test_nothing_is_said_while_running_or_by_losses_that_cannot_say() -> None:
    assert undetermined_lines(_state(KNOWN, Phase.RUNNING), SESSION) == ""  # pyright: ignore
    assert undetermined_lines(_state(None, Phase.IDLE), SESSION) == ""  # pyright: ignore


def test_base_frames_are_named_only_above_the_threshold() -> None:
    for gain, said in ((None, False), (BASE_FRAME_GAIN - 0.01, False), (BASE_FRAME_GAIN + 0.01, True)):
        line = calibration_line(gain)
        assert ("13 %" in line) == said and bool(line) == said
