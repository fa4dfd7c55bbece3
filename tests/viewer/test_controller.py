"""What intents do to the state, with the real optimizer, without threads or a page."""

import inspect
import pkgutil
import threading
from importlib import import_module

import numpy as np
import pytest
from viewer_desk import Desk
from viewer_tab import decoded

from carts_core.errors import CartsError, SettingsError
from carts_core.optimization import FrameOptimizer, FreeParameters
from carts_core.project import Source
from carts_core.project.values import ReviewState
from carts_viewer import actions, controller
from carts_viewer.actions import intents
from carts_viewer.actions.context import Handler
from carts_viewer.picture.layers import Layer
from carts_viewer.state import Phase
from carts_viewer.tabs import IntentQueue


def _taken(queue: IntentQueue[str], timeout: float) -> list[intents.Intent]:
    return [asked.intent for asked in queue.take(timeout)]


def test_the_queue_keeps_the_newest_value_of_each_joint_and_every_press_in_order() -> None:
    queue = IntentQueue[str]()
    for value in range(100):
        queue.put("one", intents.SetJoint("PSM1", 0, float(value)))
    queue.put("one", intents.SetJoint("PSM2", 0, 3.0))
    for _ in range(3):
        queue.put("one", intents.MoveFrame(1))
    queue.put("one", intents.SetJoint("PSM1", 0, 100.0))
    assert queue.waits("one", intents.SetJoint("PSM1", 0, 0.0).key) and not queue.empty()
    moves = [intents.MoveFrame(1)] * 3
    edits = [intents.SetJoint("PSM1", 0, 99.0), intents.SetJoint("PSM2", 0, 3.0)]
    assert _taken(queue, 0) == [*edits, *moves, intents.SetJoint("PSM1", 0, 100.0)]
    assert _taken(queue, 0) == [] and queue.empty() and not queue.waits("one", intents.SetJoint("PSM1", 0, 0.0).key)


@pytest.mark.parametrize(
    "given",
    [
        (intents.Released(), intents.PointAt(9.0, 9.0), intents.Released()),
        (intents.PointAt(1.0, 1.0), intents.Released(), intents.PointAt(9.0, 9.0), intents.Released()),
        (intents.ShowFrame(5), intents.SetNote("blurred"), intents.ShowFrame(6), intents.SetNote("clear")),
        (intents.ShowFrame(5), intents.SetReview(ReviewState.ACCEPTED), intents.ShowFrame(6)),
        (intents.SetJoint("PSM1", 0, 0.1), intents.Undo(), intents.SetJoint("PSM1", 0, 0.2)),
    ],
)
def test_a_gesture_or_a_frame_is_never_joined_with_the_next_one(given: tuple[intents.Intent, ...]) -> None:
    queue = IntentQueue[str]()
    for intent in given:
        queue.put("one", intent)
        queue.put("one", intents.Drawn(0))
        queue.put("two", intents.MoveFrame(1))
    assert [queued.intent for queued in queue.take(0) if queued.tab == "one"] == [*given, intents.Drawn(0)]


def test_frames_passed_by_a_scrub_are_left_out() -> None:
    queue = IntentQueue[str]()
    for index in range(9):
        queue.put("one", intents.ShowFrame(index))
        queue.put("one", intents.Drawn(0))
    assert _taken(queue, 0) == [intents.ShowFrame(8), intents.Drawn(0)]


def test_a_wait_for_the_queue_ends_with_a_put_from_another_thread_and_with_nothing_when_woken() -> None:
    queue = IntentQueue[str]()
    threading.Timer(0.05, lambda: queue.put("one", intents.ShowFrame(1))).start()
    assert _taken(queue, 20) == [intents.ShowFrame(1)]
    threading.Timer(0.05, queue.wake).start()
    assert _taken(queue, 20) == []


ENDING_A_RUN = (
    intents.SetJoint("PSM1", 0, 0.1),
    intents.MoveFrame(1),
    intents.SetSetting("iterations", 9),
    intents.ShowDomain("smoke"),
)
"""Intents that change the inputs of a run."""


def test_every_intent_has_a_handler() -> None:
    modules = [
        controller,
        *(import_module(f"carts_viewer.actions.{each.name}") for each in pkgutil.iter_modules(actions.__path__)),
    ]
    handlers = {
        one for module in modules for one in vars(module).values() if inspect.isclass(one) and issubclass(one, Handler)
    }
    handled = {name.removeprefix("_on_") for handler in handlers for name in vars(handler) if name.startswith("_on_")}
    kinds = {kind for kind in vars(intents).values() if inspect.isclass(kind) and issubclass(kind, intents.Intent)}
    assert handled == {kind.__name__ for kind in kinds if not any(base in kind.__subclasses__() for base in kinds)}


@pytest.mark.parametrize("intent", [intents.ShowCamera("top"), intents.ShowDomain("rain")])
def test_an_unknown_camera_or_domain_is_refused_with_the_known_ones(desk: Desk, intent: intents.Intent) -> None:
    with pytest.raises(CartsError, match="This sequence has: "):
        desk.do(intent)
    assert (desk.state.camera, desk.state.domain) == ("left", "regular")


def test_a_value_that_is_no_number_is_refused(desk: Desk) -> None:
    before = desk.joint()
    for value in (float("nan"), float("inf")):
        for intent in (
            intents.SetJoint("PSM1", 0, value),
            intents.SetOpacity(value),
            intents.SetSpeed(value),
            intents.Perturb(value, 0),
        ):
            with pytest.raises(CartsError, match="not a finite number"):
                desk.do(intent)
    assert desk.joint() == before


def test_numbers_out_of_range_are_clamped(desk: Desk) -> None:
    assert [desk.do(intents.ShowFrame(index)).index for index in (99, -5)] == [2, 0]
    assert desk.do(intents.SetOpacity(7.0)).opacity == 1.0
    assert desk.do(intents.SetSpeed(1e9)).fps <= 60.0
    desk.do(intents.SetJoint("PSM1", 0, 1e9))
    assert desk.joint() == pytest.approx(desk.session.ranges["PSM1"][0].upper, abs=1e-6)


def test_a_run_follows_every_iterate_and_ends_at_the_best(desk: Desk) -> None:
    desk.do(intents.Perturb(2.0, 0), intents.Run())
    assert desk.state.run.phase is Phase.RUNNING
    desk.advance()
    first = desk.state
    assert len(first.run.curves.loss) == 1
    assert first.maps is not None and first.maps.cameras == ("left", "right")
    assert len(first.maps.iterate.attention) == 2
    state = desk.finish()
    assert state.run.phase is Phase.IDLE and state.run.reason == "Done: the best iteration is the result"
    assert len(state.run.curves.loss) == 5 and len(state.run.curves.scores) == 5
    assert min(state.run.curves.loss) < state.run.curves.loss[0]
    assert state.maps is not None and state.maps.iterate.loss == min(state.run.curves.loss)
    assert state.run.curves.loss[state.run.curves.best] == state.maps.iterate.loss
    assert state.pose.source is Source.OPTIMIZER
    assert desk.saved.joints(0)["PSM1"].joint_positions == tuple(state.pose.scene.joint_positions[0].tolist())


def test_a_step_is_one_iteration_and_a_run_goes_on_where_it_paused(desk: Desk) -> None:
    for count in (2, 3):
        desk.do(intents.Step())
        assert len(desk.state.run.curves.loss) == count and desk.state.run.phase is Phase.PAUSED
    desk.do(intents.Run())
    desk.advance()
    desk.do(intents.Pause())
    assert desk.state.run.phase is Phase.PAUSED and desk.wait_time() is None
    desk.do(intents.Run())
    assert len(desk.finish().run.curves.loss) == 5


@pytest.mark.parametrize("intent", ENDING_A_RUN)
def test_a_run_stops_when_what_it_works_on_changes(desk: Desk, intent: intents.Intent) -> None:
    desk.do(intents.Run())
    desk.advance()
    state = desk.do(intent)
    assert state.run.phase is Phase.IDLE
    assert desk.wait_time() is None


def test_a_setting_out_of_range_is_kept_out_and_run_says_why(desk: Desk) -> None:
    state = desk.do(intents.SetSetting("iterations", 0))
    assert state.settings.iterations == 4 and "iterations" in (state.settings_error or "")
    with pytest.raises(SettingsError, match="iterations is 0"):
        desk.do(intents.Run())
    assert desk.do(intents.SetSetting("iterations", 3)).settings_error is None
    assert len(desk.do(intents.Run()) and desk.finish().run.curves.loss) == 4


def test_a_locked_joint_does_not_move(desk: Desk) -> None:
    name = desk.session.scene.arms[0].robot.joint_names[0]
    desk.do(intents.Perturb(2.0, 0), intents.SetFreeJoint("PSM1", name, False))
    before, other = desk.joint(0), desk.joint(1)
    desk.do(intents.Run())
    desk.finish()
    assert desk.joint(0) == pytest.approx(before) and desk.joint(1) != pytest.approx(other)
    assert desk.do(intents.SetFreeJoint("PSM1", name, True)).free == FreeParameters()


def test_a_freed_camera_moves_in_the_pose_and_the_other_camera_stays(desk: Desk) -> None:
    desk.do(intents.SetCameras(False), intents.SetFreeGroup("extrinsics", True), intents.Run())
    state = desk.finish()
    calibrated = [camera.T_camera_world for camera in desk.session.scene.cameras]
    left, right = state.pose.scene.T_camera_world
    assert np.abs(left - calibrated[0]).max() > 1e-5
    assert np.allclose(right, calibrated[1], atol=1e-6)


def test_maps_are_there_without_a_run_when_they_are_looked_at(desk: Desk) -> None:
    for layer in (Layer.ATTENTION, Layer.SIMILARITY):
        desk.do(intents.ShowLayer(layer))
        desk.controller.map()
        state = desk.state
        assert state.maps is not None
        picture = desk.renderer.overlay(state.pose.scene, state.frame, "left", layer, 1.0, state.maps)
        assert picture[..., 3].all() and np.unique(picture[..., :3].reshape(-1, 3), axis=0).shape[0] > 1


def test_a_refined_mask_follows_the_pose_and_shows_the_rendered_outline(desk: Desk) -> None:
    desk.do(intents.ShowLayer(Layer.REFINED))
    desk.controller.map()
    before = desk.state.refined_mask(desk.state.pose.scene, "left")
    assert before is not None
    rendered = desk.renderer.mask(desk.state.pose.scene, "left")
    assert 0 < (before != rendered).mean() < 0.1
    picture = desk.renderer.refined(desk.state.pose.scene, "left", before, 0.5)
    white = (picture == 255).all(-1)
    assert white.any() and not (white & ~rendered).any()
    np.testing.assert_array_equal(picture[..., 3] > 0, before | white)
    desk.do(intents.ExportMask(7))
    np.testing.assert_array_equal(decoded(desk.delivered[0][2]) > 0, before)
    desk.do(intents.Perturb(4.0, 3))
    assert desk.state.refined_mask(desk.state.pose.scene, "left") is None
    desk.controller.map()
    after = desk.state.refined_mask(desk.state.pose.scene, "left")
    assert after is not None and (after != before).any()


def test_the_exported_mask_is_what_is_shown(desk: Desk) -> None:
    desk.do(intents.Perturb(4.0, 3), intents.ShowCamera("right"), intents.ExportMask(7))
    client, name, content = desk.delivered[0]
    mask = decoded(content)
    assert (client, name) == (7, "tiny_001_right.png")
    assert set(np.unique(mask)) == {0, 255}
    assert np.array_equal(mask > 0, desk.renderer.arm_ids(desk.state.pose.scene, "right") >= 0)


def test_an_error_of_what_is_going_on_stops_it_and_is_part_of_the_state(desk: Desk) -> None:
    desk.do(intents.Export("masks", "All"), intents.Run(), intents.Play(True))
    desk.fail(CartsError("the disk is on fire"))
    state = desk.state
    assert state.error == "the disk is on fire" and not state.playing and state.export is None
    assert state.run.phase is Phase.IDLE and desk.wait_time() is None
    assert desk.do(intents.DismissError()).error is None


@pytest.mark.parametrize("intent", [ENDING_A_RUN[0], intents.SetFreeGroup("base_frames", True), intents.Run()])
def test_a_suspicion_against_base_frames_lasts_until_something_changes(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, intent: intents.Intent
) -> None:
    monkeypatch.setattr(FrameOptimizer, "base_frame_gain", lambda self: 0.4)
    desk.do(intents.Run())
    desk.advance()
    assert desk.state.run.base_frame_gain is None
    assert desk.finish().run.base_frame_gain == 0.4
    assert desk.do(intent).run.base_frame_gain is None


def test_playing_goes_round_in_the_range_and_solving_and_jobs_keep_to_it(desk: Desk) -> None:
    assert desk.do(intents.SetRange((2, 1))).range == (1, 2)
    desk.do(intents.ShowFrame(0), intents.Play(True))
    seen = []
    for _ in range(4):
        desk.controller._browsing._next_frame_at = 0.0
        desk.advance()
        seen.append(desk.state.index)
    assert seen == [1, 2, 1, 2]
    assert desk.state.playing and not desk.do(intents.Play()).playing
    desk.do(intents.OptimizeFrames("range"))
    assert desk.state.jobs[-1].title == "Optimize 2 frames individually"
    desk.do(intents.CancelJob(1), intents.SetSetting("solver", "surface"), intents.Solve(whole=True))
    assert desk.state.jobs[-1].title == "Solve frames 002 to 003"
    desk.finish()
    assert desk.state.solve is not None and desk.state.solve.frames == range(1, 3)
    assert not desk.saved.joints(0)


def test_a_range_is_marked_frame_by_frame_and_the_whole_sequence_is_none(desk: Desk) -> None:
    assert desk.do(intents.ShowFrame(1), intents.MarkRange()).range == (1, 2)
    assert desk.do(intents.MarkRange(end=True)).range == (1, 1)
    assert desk.do(intents.ShowFrame(0), intents.MarkRange(end=True)).range == (0, 0)
    assert desk.do(intents.SetRange((-3, 10**8))).range is None
    assert desk.do(intents.SetRange((1, 2)), intents.SetRange(None)).range is None
