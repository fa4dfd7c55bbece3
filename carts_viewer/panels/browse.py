"""Panels of the shown frame and of the layer that is drawn over it."""

from datetime import UTC, datetime

import numpy as np
import viser

from carts_core.model.parts import part_classes
from carts_core.project import Key, Source
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.actions.browsing import SPEEDS
from carts_viewer.actions.frame_filter import BY_HAND, SOLVED, is_copied
from carts_viewer.panels.inputs import PanelPage, humanized, swatch, write
from carts_viewer.picture.layers import ARM_COLORS, RENDERED_COLOR, TRUTH_COLORS, Layer, label_color
from carts_viewer.picture.overlay import with_imported
from carts_viewer.session import Session
from carts_viewer.state import ComparedPose, CompareMode, Scores, ViewState
from carts_viewer.transport.document import escaped

_SOURCES = {
    Source.MEASURED: "measured",
    Source.HAND: BY_HAND,
    Source.OPTIMIZER: "optimized",
    Source.PROPAGATED: SOLVED,
}


class BrowsePanel:
    """Frame slider, transport buttons, domain and camera."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        sequence = session.sequence
        self._session = session
        self._waits = page.waits
        self._count = len(sequence)
        stamps = sequence.timestamps
        self._began = 0.0 if stamps is None else float(stamps[0])
        # The last scores are shown until those of a newer pose are computed, so that the line does not jump.
        self._scores = Scores()
        with gui.add_folder("Sequence"):
            # A slider needs two different ends even for a sequence of a single frame.
            self._frame = gui.add_slider("Frame", 1, max(self._count, 2), 1, 1, disabled=self._count == 1)
            back = page.button("Previous frame", intents.MoveFrame(-1), icon=viser.Icon.CHEVRON_LEFT)
            self._play = page.button("Play", intents.Play(), icon=viser.Icon.PLAYER_PLAY)
            forward = page.button("Next frame", intents.MoveFrame(1), icon=viser.Icon.CHEVRON_RIGHT)
            page.row(back, self._play, forward, weights=(1, 2, 1), icons=(back, forward))
            self._speed = gui.add_number("Frames/s", 10.0, min=SPEEDS[0], max=SPEEDS[1], step=0.5)
            self._domains = {humanized(name): name for name in sequence.domains}
            self._domain = gui.add_dropdown("Domain", list(self._domains), visible=len(self._domains) > 1)
            cameras = [camera.name for camera in sequence.scene.cameras]
            self._camera = gui.add_dropdown("Camera", cameras, visible=len(cameras) > 1)
            offset = session.time_offset
            self._offset = gui.add_number(
                "Time offset [s]",
                offset or 0.0,
                step=0.005,
                visible=offset is not None,
                hint="Kinematics clock minus image clock. Reduce it if the overlay leads the image.",
            )
            if sequence.remarks:
                lines = "".join(f"<li>{escaped(remark)}</li>" for remark in sequence.remarks)
                count = counted(len(sequence.remarks), "remark")
                gui.add_html(
                    f"<details class='carts-remarks'><summary>⚠ {count} about the files</summary>{lines}</details>"
                )
            self._error = gui.add_html("", visible=False)
            self._caption = gui.add_html("")
        page.on_input(self._frame, lambda value: intents.ShowFrame(int(value) - 1))
        page.on_input(self._speed, intents.SetSpeed)
        page.on_input(self._offset, intents.SetTimeOffset)
        page.on_input(self._domain, lambda label: intents.ShowDomain(self._domains[label]))
        page.on_input(self._camera, intents.ShowCamera)

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        if not self._waits(intents.ShowFrame):
            write(self._frame, state.index + 1)
        if not self._waits(intents.SetSpeed):
            write(self._speed, state.fps)
        self._error.visible = state.time_error is not None
        self._error.content = f'<p class="carts-error">{escaped(state.time_error or "")}</p>'
        offset = self._session.time_offset
        # A half-typed invalid value stays in the field.
        if offset is not None and state.time_error is None and not self._waits(intents.SetTimeOffset):
            write(self._offset, offset)
        write(self._domain, next(label for label, name in self._domains.items() if name == state.domain))
        write(self._camera, state.camera)
        self._play.label = "Stop" if state.playing else "Play"
        self._play.icon = viser.Icon.PLAYER_STOP if state.playing else viser.Icon.PLAYER_PLAY
        self._caption.content = f'<p class="carts-caption">{self._describe(state)}</p>'

    @staticmethod
    def _source(state: ViewState) -> str:
        if state.pose.source is Source.PROPAGATED and is_copied(state.project, state.index):
            return "copied from another frame"
        return _SOURCES[state.pose.source]

    def _describe(self, state: ViewState) -> str:
        """Name of a live frame, source of the joint positions, time and scores, as HTML."""
        if state.live is not None and state.live.on:
            if state.live.busy:
                self._scores = Scores()
                return "The recording, until the first live frame arrives"
            parts = [f"Live frame <b>{escaped(state.frame.frame_id)}</b>"]
        else:
            parts = [self._source(state)]
        if state.frame.timestamp is not None:
            parts.append(_time(state.frame.timestamp, self._began))
        scores = self._scores = state.scores or self._scores
        if scores.dice is not None:
            parts.append(f"Dice <b>{scores.dice:.3f}</b>")
        if scores.joint_degrees is not None:
            parts.append(
                f'<span title="Mean error of the revolute joints">error <b>{scores.joint_degrees:.2f}°</b></span>'
            )
        return " · ".join(parts)


_CALENDAR = 1e8
"""Minimum timestamp that is interpreted as the time since 1970, as in ROS, and shown as a date [s]."""


def _time(stamp: float, began: float) -> str:
    """Timestamp of a frame, as HTML; a time since 1970 is shown relative to the first frame, with its date as hint."""
    if stamp < _CALENDAR:
        return f"{stamp:.3f} s"
    date = f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M:%S} UTC"
    return f'<span title="{stamp:.6f} s since 1970, {date}">{stamp - began:.3f} s</span>'


_NOTHING = "Nothing"
_RAMPS = {
    Layer.ATTENTION: '<span class="carts-ramp"></span> 0 (no weight) to 1 (full weight)',
    Layer.SIMILARITY: '<span class="carts-ramp"></span> 0 (different) to 1 (similar)',
}


class OverlayPanel:
    """Layer, opacity and legend of the overlay, and comparison with another pose."""

    def __init__(self, page: PanelPage, session: Session, state: ViewState) -> None:
        gui = page.gui
        self._waits, self._session = page.waits, session
        self._arms = [arm.name for arm in session.scene.arms]
        self._classes = part_classes(session.scene.arms)
        with gui.add_folder("Overlay"):
            self._layer = gui.add_dropdown("Layer", [str(layer) for layer in Layer], initial_value=str(state.layer))
            self._opacity = gui.add_slider("Opacity %", 0, 100, 5, round(100 * state.opacity))
            self._legend = gui.add_html("")
            self._mode = gui.add_dropdown(
                "Compare",
                [_NOTHING, *map(str, CompareMode)],
                hint="Hold {peek} to see only the left or the measured pose",
            )
            self._sides = [
                gui.add_dropdown(
                    side, list(map(str, ComparedPose)), visible=False, hint=f"Pose on the {side.lower()} of the line"
                )
                for side in ("Left", "Right")
            ]
        page.on_input(self._layer, lambda value: intents.ShowLayer(Layer(value)))
        page.on_input(self._mode, lambda mode: self._compared(mode=mode))
        for side, handle in zip(("left", "right"), self._sides, strict=True):
            page.on_input(handle, lambda pose, side=side: self._compared(**{side: pose}))
        page.on_input(self._opacity, lambda value: intents.SetOpacity(value / 100))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        write(self._layer, str(state.layer))
        if not self._waits(intents.SetOpacity):
            write(self._opacity, round(100 * state.opacity))
        compare = state.compare
        if not self._waits(intents.CompareWith):
            write(self._mode, str(compare.mode or _NOTHING))
            for handle, pose in zip(self._sides, (compare.left, compare.right), strict=True):
                write(handle, str(pose))
                handle.visible = compare.mode is CompareMode.SWIPE
        # The legend of these comparisons is over the image.
        over_image = compare.mode in (CompareMode.OUTLINES, CompareMode.PAINTED)
        self._legend.content = f'<div class="carts-legend">{"" if over_image else self._describe(state)}</div>'

    def _compared(self, mode: str = "", left: str = "", right: str = "") -> intents.CompareWith:
        """The comparison that the lists show, with one new choice."""
        mode = mode or self._mode.value
        left, right = left or self._sides[0].value, right or self._sides[1].value
        chosen = None if mode == _NOTHING else CompareMode(mode)
        return intents.CompareWith(chosen, ComparedPose(left), ComparedPose(right))

    def _describe(self, state: ViewState) -> str:
        if state.layer in (Layer.MASK, Layer.CONTOUR, Layer.REFINED):
            swatches = [swatch(ARM_COLORS[number % len(ARM_COLORS)], name) for number, name in enumerate(self._arms)]
            if state.layer is Layer.REFINED:
                swatches.append(swatch(RENDERED_COLOR, "Outline of the rendered mask"))
            return " ".join(swatches)
        if state.layer is Layer.PARTS:
            return " ".join(swatch(label_color(one.number), one.name) for one in self._classes)
        if state.layer is Layer.TRUTH:
            if state.camera not in (with_imported(state.frame, self._session.scene, state.project).masks or {}):
                return "This frame has no ground-truth mask."
            return " ".join(swatch(color, name.capitalize()) for name, color in TRUTH_COLORS.items())
        if state.layer is Layer.IMPORTED:
            return self._describe_imported(state)
        return _RAMPS.get(state.layer, "")

    def _describe_imported(self, state: ViewState) -> str:
        """Legend of the imported labels in the shown frame."""
        layer = state.project.get(Key.imported_mask(state.index, state.camera))
        points = state.project.get(Key.imported_keypoints(state.index, state.camera))
        known = state.project.get(Key.imported_labels())
        names = () if known is None else known.names
        if layer is None and points is None:
            return "Nothing was imported for this frame and camera."
        there = set() if layer is None else set(np.unique(layer.labels()).tolist())
        swatches = [swatch(label_color(n), name) for n, name in enumerate(names, start=1) if n in there]
        count = 0 if points is None else len(points.points)
        return " ".join([*swatches, *([counted(count, "keypoint")] if count else [])]) or "This mask is empty."
