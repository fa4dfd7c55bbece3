"""The document at the side of the picture: what to click next, how well the arm is known, and what to do then."""

import math
from collections.abc import Sequence as Rows

from carts_core.optimization.hand_eye import HandEyeResult, ImagePoint, PoseDeviation
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
    parts = [_calibration(draft, clicking), asked, _known(draft, clicking), _refine(draft, clicking, progress)]
    return head + "".join(parts) + _save(draft, clicking, folder)


def _running(progress: Progress) -> str:
    return (
        f"<h2>Calibrating over {FRAMES} frames</h2><progress max='1' value='{progress.share:.2f}'></progress>"
        f"<p>{escaped(progress.text)}</p>{button('cancel', 'Stop')}"
    )


def _calibration(draft: Draft, clicking: Clicking) -> str:
    """Figures of a calibration, and the choice whether one that the points speak against is kept."""
    report = draft.report
    if report is None:
        return ""
    verdict = f"<b>{escaped(report.verdict.capitalize())}.</b> " if report.verdict else ""
    if draft.offered is not None:
        title = "Calibration not kept"
        choice = (
            f'<div class="note guessed">{escaped(report.objection)} The outline shows this calibration. Keep it if '
            "these clicks are wrong.</div>"
            f"<div class='bar'>{button('keep', 'Keep anyway')}{button('discard', 'Discard')}</div>"
        )
    else:
        title, choice = "Calibrated", ""
        if report.objection:
            choice = f'<div class="note guessed">Kept by choice. {escaped(report.objection)}</div>'
    poses = "".join(
        f"<tr><td>{escaped(pose.arm)}, {escaped(pose.camera)}</td><td>{pose.turn_deg:.2f}°</td>"
        f"<td>{pose.shift_mm:.1f} mm</td></tr>"
        for pose in report.poses
    )
    return (
        f"<h2>{title}</h2>{choice}<p>{verdict}{escaped(report.reason)}</p>"
        f"<p>Loss {report.loss_before:.4f} → {report.loss_after:.4f}</p>"
        f"<table><tr><th></th><th>turn</th><th>shift of the tip</th></tr>{poses}</table>{_residuals(draft, clicking)}"
    )


def _residuals(draft: Draft, clicking: Clicking) -> str:
    """The residual of each point before and after the calibration."""
    report = draft.report
    assert report is not None
    cameras, arms = clicking.sequence.scene.cameras, clicking.sequence.scene.arms
    rows = []
    for row, (point, old, new) in enumerate(zip(draft.points, report.before, report.after, strict=True)):
        name = point.landmark if len(arms) == 1 else f"{point.arm}: {point.landmark}"
        place = f"frame {clicking.sequence.frame_ids[point.frame]}" + (f", {point.camera}" if len(cameras) > 1 else "")
        values = "".join(f"<td>{'–' if value is None else f'{value:.1f}'}</td>" for value in (old, new))
        wrong = ' class="wrong"' if row in report.disagreeing else ""
        rows.append(f"<tr{wrong}><td class='name'>{escaped(name)} <small>{escaped(place)}</small></td>{values}</tr>")
    return (
        "<details open><summary>Residuals of points [px]</summary>"
        f"<table><tr><th></th><th>before</th><th>after</th></tr>{''.join(rows)}</table></details>"
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
        return f"<h2>Uncertainty</h2><p>{escaped(text)}</p>{focal}"
    result, report = clicking.result, draft.report
    deviations = result.deviations
    if report is not None:
        deviations = {(pose.arm, pose.camera): pose.deviation for pose in report.poses}
    rows = "".join(_deviation(*key, deviation) for key, deviation in deviations.items())
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
        f"<h2>Uncertainty</h2><p>{'Of the calibration from points' if report is None else 'Of the new calibration'}; "
        f"RMS residual of points <b>{_rms(draft, result):.1f} px</b>.</p>"
        f"<table><tr><th></th><th>sideways</th><th>in depth</th><th>turn</th></tr>{rows}</table>"
        f"{lengths}{missing}{_wrong(draft, clicking, result)}{focal}"
    )


def _rms(draft: Draft, result: HandEyeResult) -> float:
    """Of the points that agree with each other [px], after the calibration if there is one."""
    if draft.report is None:
        return result.error
    agreeing = [row for row in range(len(draft.points)) if row not in result.contradicting]
    values = [value for row in agreeing if (value := draft.report.after[row]) is not None]
    return math.sqrt(sum(value**2 for value in values) / max(len(values), 1))


def _deviation(arm: str, camera: str, deviation: PoseDeviation) -> str:
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
    elif draft.calibration is not None and draft.report is None:
        done = '<div class="note good">Calibrated</div>'
    begin = button("calibrate", "Calibrate", kind="main", disabled=clicking.result is None)
    return (
        "<h2>Refine</h2><p>Fits base frames and cameras to what the network sees in 20 frames. Takes a minute or two."
        f"</p><div class='bar'>{begin}</div>{done}"
    )


def _save(draft: Draft, clicking: Clicking, folder: str) -> str:
    ready = clicking.result is not None or draft.calibration is not None
    remark = "" if ready else "<p class='quiet-text'>Without points the arm stays at a stand-in.</p>"
    if draft.offered is not None:
        remark = "<p class='quiet-text'>Saves the calibration from the points, since the new one is not kept.</p>"
    begin = button("save", "Save and open", kind="main" if draft.calibration is not None else "")
    return (
        f"<h2>Save</h2><div class='bar'>{text_field('name', draft.name, label='Name')}</div>"
        f"<p class='quiet-text'>To <code>{escaped(folder)}</code></p>{remark}"
        f"<div class='bar'>{begin}</div>"
    )
