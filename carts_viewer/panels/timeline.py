"""Data of the page's timeline: codes of frames, curves, and thumbnails."""

import asyncio
import http
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from websockets.http11 import Response

from carts_core.errors import CartsError
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import undetermined_joints
from carts_core.project import ProjectState, ReviewState, Source
from carts_core.project.state import Record
from carts_core.project.values import VERDICTS, WHOLE_PROJECT
from carts_core.recording import Frame, Sequence
from carts_core.recording.images import ImageSource
from carts_core.rendering import ImageRenderer
from carts_viewer.actions.frame_filter import BY_HAND, SOLVED, review_name
from carts_viewer.panels.inputs import humanized
from carts_viewer.picture.layers import mask, small_jpeg
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.events import Trace
from carts_viewer.transport.guard import response
from carts_viewer.transport.page import TabPage

_FIGURES = ("Loss", "Dice", "Probability of failure [%]")
_MAX_COLUMNS = 4000


class Traces:
    """Curves over all frames, updated when the project changes."""

    def __init__(self, session: Session) -> None:
        frames = len(session.sequence)
        self._sequence: Sequence | None = None
        self._figures = np.full((len(_FIGURES), frames), np.nan, np.float32)
        self._joints = {
            f"{limits.arm} {humanized(limits.joint)} [{limits.unit}]": (limits, number)
            for arm in session.scene.arms
            for number, limits in enumerate(session.ranges[arm.name])
        }
        self._corrected: dict[str, Float[np.ndarray, "frames dofs"]] = {
            arm.name: np.full((frames, len(arm.robot.joint_names)), np.nan, np.float32) for arm in session.scene.arms
        }
        self.measure(session.sequence)

    @property
    def names(self) -> list[str]:
        """Names of the curves, with units."""
        return [*_FIGURES, *self._joints]

    def measure(self, sequence: Sequence) -> bool:
        """Use the measured joints of this sequence; returns whether they have changed."""
        other = sequence is not self._sequence
        self._sequence = sequence
        return other

    def follow(self, project: ProjectState, frames: Iterable[int]) -> None:
        """Update the values of these frames from a project."""
        for frame in frames:
            figures, verdict = project.figures(frame), project.verdict(frame)
            values = (
                None if figures is None else figures.loss,
                None if figures is None else figures.dice,
                None if verdict is None else 100.0 * verdict.failure,
            )
            self._figures[:, frame] = [np.nan if value is None else value for value in values]
            corrections = project.joints(frame)
            for arm, rows in self._corrected.items():
                known = corrections.get(arm)
                rows[frame] = np.nan if known is None else known.joint_positions

    def between(self, name: str, first: int, last: int, columns: int) -> dict[str, Any] | None:
        """A curve from frame `first` up to but excluding `last`; None if there is no such curve.

        Returns:
            `edges`: first frame of each column, and the end of the last column; `curves`: minima and maxima of
            the columns, null without a value; one entry for a figure, two for the measured and the corrected values of
            a joint.
        """
        first, last = max(first, 0), min(last, self._figures.shape[1])
        values = self._values(name)
        if values is None or last <= first or columns < 1:
            return None
        count = min(columns, _MAX_COLUMNS, last - first)
        edges = np.unique(np.linspace(first, last, count + 1).astype(int))
        return {"edges": edges.tolist(), "curves": [_extremes(row[first:last], edges - first) for row in values]}

    def _values(self, name: str) -> list[np.ndarray] | None:
        if name in _FIGURES:
            return [self._figures[_FIGURES.index(name)]]
        if name not in self._joints or self._sequence is None:
            return None
        limits, joint = self._joints[name]
        scale = limits.to_shown(1.0)
        return [rows[limits.arm][:, joint] * scale for rows in (self._sequence.measured, self._corrected)]


def _extremes(values: np.ndarray, edges: np.ndarray) -> list[list[float | None]]:
    """Minima and maxima of the finite values between adjacent edges."""
    ends = (np.fmin.reduceat(values, edges[:-1]), np.fmax.reduceat(values, edges[:-1]))
    return [[None if np.isnan(value) else float(f"{value:.5g}") for value in end] for end in ends]


THUMBNAIL_HEIGHT = 64
"""Height of thumbnails [px]; displayed smaller, for screens with several pixels per CSS pixel."""
_MAX_THUMBNAILS = 4000
"""Maximum number of cached thumbnails of about 3 kB; the least recently used are removed first."""
_QUALITY = 70
_OPACITY = 0.5
_PATH = re.compile(r"(\d{1,4})/(\d{1,4})/(\d{1,9})(-\d{1,9})?\.jpg")


class Thumbnails:
    """Thumbnails of one sequence.

    Args:
        pose: the pose of a frame, which is read without images.
    """

    def __init__(self, sequence: Sequence, pose: Callable[[Frame], SceneState]) -> None:
        self._sequence, self._pose = sequence, pose
        self._renderers: dict[int, ImageRenderer] = {}
        self._cameras = [camera.name for camera in sequence.scene.cameras]
        self._sources: dict[tuple[int, int], ImageSource] = {}
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()
        # A single thread, since scrubbing needs the processor more.
        self._thread = ThreadPoolExecutor(1, "carts-thumbnails")

    async def answer(self, path: str) -> Response:
        """The picture at `CAMERA/DOMAIN/FRAME.jpg`, given by indices, or with the overlay of the frame's pose at
        `CAMERA/DOMAIN/FRAME-NUMBER.jpg`, with any number; status 404 if there is none."""
        content = self._find(path)
        if content is None:
            try:
                content = await asyncio.get_running_loop().run_in_executor(self._thread, self._make, path)
            except RuntimeError:  # The viewer is being closed.
                content = None
        if content is None:
            return response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"No such picture.")
        return response(http.HTTPStatus.OK, "image/jpeg", content)

    def close(self) -> None:
        """Stop making thumbnails."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _source(self, camera: int, domain: int) -> ImageSource:
        """Recorded images of a camera and domain; videos get a separate reader."""
        if (camera, domain) not in self._sources:
            source = self._sequence.image_source(self._cameras[camera], self._sequence.domains[domain])
            another = getattr(source, "another", None)
            self._sources[camera, domain] = source if another is None else another()
        return self._sources[camera, domain]

    def _find(self, path: str) -> bytes | None:
        with self._lock:
            if path in self._kept:
                self._kept.move_to_end(path)
            return self._kept.get(path)

    def _make(self, path: str) -> bytes | None:
        found = _PATH.fullmatch(path)
        if found is None:
            return None
        camera, domain, frame = map(int, found.groups()[:3])
        known = camera < len(self._cameras) and domain < len(self._sequence.domains) and frame < len(self._sequence)
        if not known:
            return None
        try:
            image = self._source(camera, domain).read(frame)
        except CartsError:
            return None
        if found[4] is not None:
            return small_jpeg(self._overlaid(image, camera, domain, frame), height=THUMBNAIL_HEIGHT, quality=_QUALITY)
        content = small_jpeg(image, height=THUMBNAIL_HEIGHT, quality=_QUALITY)
        with self._lock:
            self._kept[path] = content
            while len(self._kept) > _MAX_THUMBNAILS:
                self._kept.popitem(last=False)
        return content

    def _overlaid(self, image: UInt8[np.ndarray, "h w 3"], camera: int, domain: int, frame: int) -> np.ndarray:
        """The image at twice the height of thumbnails, with the masks of the arms."""
        height = 2 * THUMBNAIL_HEIGHT
        size = 2 * max(1, round(image.shape[1] * THUMBNAIL_HEIGHT / image.shape[0])), height
        if camera not in self._renderers:
            scene, name = self._sequence.scene, self._cameras[camera]
            self._renderers[camera] = ImageRenderer(scene, width=size[0], height=height, cameras=[name])
        state = self._pose(self._sequence.frame(frame, self._sequence.domains[domain], []))
        overlay = mask(self._renderers[camera].segment(state)[0], 1.0)
        opacity = overlay[..., 3:] / np.float32(255) * _OPACITY
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return (small + (overlay[..., :3] - small.astype(np.float32)) * opacity).astype(np.uint8)


_REVIEWS = (
    ReviewState.UNTOUCHED,
    ReviewState.OPTIMIZED,
    ReviewState.NEEDS_WORK,
    ReviewState.ACCEPTED,
    ReviewState.REJECTED,
    BY_HAND,
    SOLVED,
)
_SOURCES = (Source.HAND, Source.OPTIMIZER, Source.PROPAGATED)
_FULL_BAR = 0.2
"""Value of 1 - Dice, or probability of failure, at which a bar has its full height [1]."""
_MAX_UNDETERMINED = 255
_MAX_IDS = 5000
"""Maximum length of a sequence whose frame names are sent; otherwise frames are named by number."""


class TimelineData:
    """Sends the codes of all frames to a tab, and then changed codes."""

    def __init__(self, page: TabPage, session: Session) -> None:
        self._page = page
        self._session = session
        self._ids = session.sequence.frame_ids
        stamps = session.sequence.timestamps
        span = 0.0 if stamps is None or len(stamps) < 2 else float(stamps[-1] - stamps[0])
        self._fps = (len(self._ids) - 1) / span if span > 0 else 0.0
        self._records: Mapping[int, Record] = {}
        self._codes: dict[int, int] = {}
        self._draft: int | None = None
        """Frame whose unsaved code was sent."""
        self._solving: list[int] | None = None
        self._traces = Traces(session)
        page.call("setTimeline", self._whole())

    def show(self, state: ViewState) -> None:
        """Send changes; an unfinished gesture changes only its own frame."""
        solving = None
        if state.solve is not None and state.solving:
            solving = [state.solve.frames[0], len(state.solve.frames), state.solve.done]
        changed = self._drafted(state) if state.unsaved else self._changed(state.project)
        measured = self._traces.measure(self._session.sequence)
        if changed or measured or solving != self._solving:
            self._solving = solving
            traced = measured or (bool(changed) and not state.unsaved)
            message = {"whole": False, "codes": changed, "solving": solving, "traced": traced}
            self._page.call("setTimeline", message)

    def answer(self, trace: Trace) -> None:
        """Send a requested curve, if it exists."""
        found = self._traces.between(trace.name, trace.first, trace.last, trace.columns)
        if found is not None:
            self._page.call("setTrace", {"name": trace.name, **found})

    def _whole(self) -> dict[str, Any]:
        codes = [number for pair in list(self._codes.items()) for number in pair]
        ids = list(self._ids) if len(self._ids) <= _MAX_IDS else None
        sequence = self._session.sequence
        return {
            "whole": True,
            "frames": len(self._ids),
            "fps": self._fps,
            "ids": ids,
            "codes": codes,
            "solving": self._solving,
            "traces": self._traces.names,
            "domains": list(sequence.domains),
            "cameras": [camera.name for camera in sequence.scene.cameras],
            "aspects": [camera.width / camera.height for camera in sequence.scene.cameras],
        }

    def _drafted(self, state: ViewState) -> list[int]:
        """Like `_changed`, for the shown frame only, during an unfinished gesture or a run."""
        self._draft, number = state.index, frame_code(state.project, state.index, self._session.scene)
        if self._codes.get(state.index, 0) == number:
            return []
        self._codes[state.index] = number
        return [state.index, number]

    def _changed(self, project: ProjectState) -> list[int]:
        """Alternating frame and code of all frames whose code has changed."""
        draft, self._draft = self._draft, None
        if project.records is self._records and draft is None:
            return []
        before, self._records = self._records, project.records
        touched = [i for i, record in project.records.items() if i >= 0 and before.get(i) is not record]
        whole = before.get(WHOLE_PROJECT) is not project.records.get(WHOLE_PROJECT)
        # A changed calibration invalidates figures and verdicts of all frames.
        indices = {i for i in project.records if i >= 0} if whole else set(touched)
        indices |= {i for i in before if i >= 0 and i not in project.records}
        indices |= set() if draft is None else {draft}
        self._traces.follow(project, indices)
        changed: list[int] = []
        for index in sorted(indices):
            number = frame_code(project, index, self._session.scene)
            if self._codes.get(index, 0) != number:
                self._codes[index] = number
                changed += [index, number]
        return changed


def frame_code(project: ProjectState, frame: int, scene: Scene) -> int:
    """Bit field of review, verdict, source, whether the frame is kept, misfit (1 to 255, 0 unknown), and number of
    undetermined joints plus one (0 unknown)."""
    record = project.records.get(frame)
    if record is None:
        return 0
    review = _REVIEWS.index(review_name(project, frame))
    verdict, figures = project.verdict(frame), project.figures(frame)
    source = next((number for number, source in enumerate(_SOURCES, start=1) if source in record.sources), 0)
    dice = None if figures is None else figures.dice
    badness = 1.0 - dice if dice is not None else None if verdict is None else verdict.failure
    return (
        review
        + 8 * (0 if verdict is None else 1 + VERDICTS.index(verdict.verdict))
        + 32 * source
        + 128 * int(record.is_kept)
        + 256 * (0 if badness is None else min(max(round(255 * badness / _FULL_BAR), 1), 255))
        + 65536 * _undetermined(project, frame, scene)
    )


def _undetermined(project: ProjectState, frame: int, scene: Scene) -> int:
    known = {name: found.standard_deviations or () for name, found in project.joints(frame).items()}
    joints = undetermined_joints(scene, known)
    return 0 if joints is None else min(1 + len(joints), _MAX_UNDETERMINED)
