"""The document at the side of the picture: what to click next, how well the arm is known, and what to do then."""

from collections.abc import Sequence as Rows

from carts_core.optimization.hand_eye import HandEyeResult, ImagePoint
from carts_core.wording import counted
from carts_viewer.recording.calibrating import FRAMES, Progress
from carts_viewer.recording.clicking import Clicking, Wish
from carts_viewer.recording.draft import Draft
from carts_viewer.transport.document import button, check_box, choices, escaped, text_field


def hand_eye_panel(
    draft: Draft,
    clicking: Clicking,
    wish: Wish | None,
    progress: Progress | None,
    problem: str,
    folder: str,
    undoable: bool,
) -> str:
    """The panel.

    Args:
        draft: with its points and its calibration.
        clicking: what is asked for, and what follows from the points.
        wish: what is to be clicked now.
        progress: of a calibration that runs or has just ended.
        problem: what went wrong last; empty if nothing did.
        folder: where the sequence would be saved.
        undoable: whether there is something to undo.
    """
    running = progress is not None and not progress.ended
    failed = problem or ("" if progress is None else progress.error)
    alert = f'<div class="problem" role="alert">{escaped(failed)}</div>' if failed else ""
    undo = button("undo", "Undo", kind="quiet", disabled=not undoable or running)
    head = (
        f'<h1>Hand-eye</h1><div class="bar">{button("back", "← Check", kind="quiet", disabled=running)}{undo}'
        f"{button('leave', 'All recordings', kind='quiet', disabled=running)}</div>{alert}"
    )
    if running:
        assert progress is not None
        return head + _running(progress)
    asked = _asked(clicking, wish, draft.points)
    return head + asked + _known(draft, clicking) + _refine(draft, clicking, progress) + _save(draft, clicking, folder)


def _running(progress: Progress) -> str:
    return (
        f"<h2>Calibrating over {FRAMES} frames</h2><progress max='1' value='{progress.share:.2f}'></progress>"
        f"<p>{escaped(progress.text)}</p>{button('cancel', 'Stop')}"
    )


def _asked(clicking: Clicking, wish: Wish | None, points: Rows[ImagePoint]) -> str:
    """What to click now; nothing once there is enough."""
    if wish is None:
        return "<h2>Points</h2><p>All points are there. More can be chosen below.</p>" + _other(clicking, wish)
    arms = f"{wish.arm}: " if len(clicking.sequence.scene.arms) > 1 else ""
    done = len({(p.camera, p.frame, p.arm, p.landmark) for p in points})
    frame = clicking.sequence.frame_ids[wish.frame]
    return (
        f"<h2>Click the {escaped(arms + wish.landmark)}</h2><p>{escaped(clicking.hint(wish.arm, wish.landmark))}</p>"
        f'<p class="quiet-text">Camera {escaped(wish.camera)}, frame {escaped(frame)} · '
        f"{counted(done, 'point')} so far, {len(clicking.plan)} are good. Zoom with the wheel.</p>"
        f'<div class="bar">{button("skip", "Not visible")}{button("skip-frame", "Other frame")}</div>'
        f"{_other(clicking, wish)}"
    )


def _other(clicking: Clicking, wish: Wish | None) -> str:
    """Any camera, frame and landmark."""
    scene, sequence = clicking.sequence.scene, clicking.sequence
    at = wish or clicking.plan[-1]
    cameras = {camera.name: camera.name for camera in scene.cameras}
    arms = {arm.name: arm.name for arm in scene.arms}
    frames = {str(index): name for index, name in enumerate(sequence.frame_ids[:2000])}
    names = {name: name for name in clicking.names(at.arm)}
    lists = [
        choices("look camera", cameras, at.camera) if len(cameras) > 1 else "",
        choices("look frame", frames, str(at.frame)),
        choices("look arm", arms, at.arm) if len(arms) > 1 else "",
        choices("look landmark", names, at.landmark),
    ]
    return f"<details><summary>Choose what to click</summary><div class='bar'>{''.join(lists)}</div></details>"


def _known(draft: Draft, clicking: Clicking) -> str:
    """How well the arms are known, and which points do not fit."""
    focal = check_box("focal_length", draft.focal_length, "Find the focal length, too")
    if clicking.result is None:
        text = clicking.problem if draft.points else "An outline follows the arm from the fourth point on."
        return f"<h2>How well it is known</h2><p>{escaped(text)}</p>{focal}"
    result = clicking.result
    rows = "".join(_deviation(result, *key) for key in result.deviations)
    lengths = "".join(
        f"<p>Focal length of {escaped(camera)}: {result.scene.camera(camera).intrinsics[0]:.0f} px "
        f"± {100 * share:.0f} %</p>"
        for camera, share in result.focal_deviation.items()
    )
    missing = "".join(
        f"<p>{escaped(arm)} in {escaped(camera)}: {counted(more, 'more point')} needed.</p>"
        for (arm, camera), more in result.missing.items()
    )
    return (
        f"<h2>How well it is known</h2><p>Points agree to <b>{result.error:.1f} px</b>.</p>"
        f"<table><tr><th></th><th>sideways</th><th>in depth</th><th>turn</th></tr>{rows}</table>"
        f"{lengths}{missing}{_wrong(draft, clicking, result)}{focal}"
    )


def _deviation(result: HandEyeResult, arm: str, camera: str) -> str:
    deviation = result.deviations[arm, camera]
    return (
        f"<tr><td>{escaped(arm)}, {escaped(camera)}</td><td>± {deviation.sideways_mm:.1f} mm</td>"
        f"<td>± {deviation.depth_mm:.1f} mm</td><td>± {deviation.rotation_deg:.1f}°</td></tr>"
    )


def _wrong(draft: Draft, clicking: Clicking, result: HandEyeResult) -> str:
    """Points that contradict the others, each with a way to take it back."""
    parts = []
    for row in result.contradicting:
        point = draft.points[row]
        where = f"{point.landmark} in frame {clicking.sequence.frame_ids[point.frame]} ({point.camera})"
        parts.append(
            f'<div class="note">The {escaped(where)} is {result.distances[row]:.0f} px off and hardly counts. '
            f"{button('remove-point', 'Remove it', str(row), kind='quiet')}</div>"
        )
    return "".join(parts)


def _refine(draft: Draft, clicking: Clicking, progress: Progress | None) -> str:
    done = ""
    if progress is not None and progress.ended and not progress.error:
        done = f'<div class="note good">{escaped(progress.text)}</div>'
    elif draft.calibration is not None:
        done = '<div class="note good">Calibrated</div>'
    begin = button("calibrate", "Calibrate", kind="main", disabled=clicking.result is None)
    return (
        "<h2>Refine</h2><p>Fits base frames and cameras to what the network sees in 20 frames. Takes a minute or two."
        f"</p><div class='bar'>{begin}</div>{done}"
    )


def _save(draft: Draft, clicking: Clicking, folder: str) -> str:
    ready = clicking.result is not None or draft.calibration is not None
    remark = "" if ready else "<p class='quiet-text'>Without points the arm stays at a stand-in.</p>"
    begin = button("save", "Save and open", kind="main" if draft.calibration is not None else "")
    return (
        f"<h2>Save</h2><div class='bar'>{text_field('name', draft.name, label='Name')}</div>"
        f"<p class='quiet-text'>To <code>{escaped(folder)}</code></p>{remark}"
        f"<div class='bar'>{begin}</div>"
    )
