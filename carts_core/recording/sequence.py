"""Recordings: frames with images, measured joint positions and, if known, masks and true joint positions."""

import hashlib
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..errors import SequenceError
from ..model.camera import Camera
from ..model.scene import Scene
from ..notebook import MEASURED_COLOUR, Picture, display
from ..reprs import short_repr
from ..wording import closest, counted
from .background import MeanBackground, background_of_recording, evenly_spaced
from .images import ByteCache, ImageFiles, ImageSource, read_file, read_image, read_mask
from .matching import TimeMatching
from .sequence_file import CameraInput, Description, read_description

CACHE_BYTES = 192 * 2**20
"""Maximum memory for decoded images and masks of one sequence [bytes]."""


@dataclass(frozen=True)
class Frame:
    """One time step of a sequence in one domain; arrays are copies."""

    index: int
    """0-based position in the sequence."""
    frame_id: str
    """Id of the frame, such as "001"."""
    domain: str
    images: dict[str, UInt8[np.ndarray, "height width 3"]]
    """Camera -> RGB image, undistorted."""
    measured: dict[str, Float[np.ndarray, " dofs"]]
    """Arm -> joint positions [rad, m] in the order of `Robot.joint_names`; defaults for unmeasured joints."""
    truth: dict[str, Float[np.ndarray, " dofs"]] | None
    """Arm -> true joint positions [rad, m]; None if the sequence has none."""
    masks: dict[str, Bool[np.ndarray, "height width"]] | None
    """Camera -> instrument mask, undistorted; None if no camera has a mask in this frame."""
    timestamp: float | None
    """Acquisition time [s]; None if not known."""
    mounts: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Camera -> T_mount_world [m], for moving cameras."""
    missing: tuple[str, ...] = ()
    """Cameras without an image of this frame; their entries of `images` are black, and the solvers ignore them."""
    unlabelled: dict[str, Bool[np.ndarray, "height width"]] = field(default_factory=dict)
    """Camera -> pixels whose label in `masks` is unknown, which scores leave out."""

    def ignoring(
        self, ignore: Mapping[str, Bool[np.ndarray, "height width"]] | None
    ) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Camera -> ignored pixels: the given ones, and all pixels of missing images."""
        blank = {name: np.ones(self.images[name].shape[:2], bool) for name in self.missing}
        return {**(ignore or {}), **blank}

    __repr__ = short_repr


@dataclass(frozen=True)
class Logged:
    """Logged values at times of the tables' clock; NaN outside the range of a table."""

    joints: dict[str, Float[np.ndarray, "times dofs"]]
    """Arm -> joint positions [rad, m]."""
    mounts: dict[str, Float[np.ndarray, "times 4 4"]]
    """Camera -> T_world_mount [m], for moving cameras."""


class Sequence:
    """Recording described by a sequence file, created by `Sequence.open`; thread-safe.

    Attributes:
        path: the sequence file.
        name: name of the recording.
        scene: calibrated arms and cameras; the cameras project to undistorted images.
        domains: variants of every image; the first is the default.
        frame_ids: id of each frame.
        timestamps: acquisition time of each image [frames] [s], or None.
        matching: matching of joint positions with frames by time, or None if each row of the table is a frame.
        measured_joints: arm -> joints in the kinematics table, in the robot's order.
        measured: arm -> joint positions of all frames [frames, dofs] [rad, m].
        truth: arm -> true joint positions of all frames, for arms with ground truth; None without ground truth.
        remarks: sentences on changes to images and masks before they are used (rotation, scaling to 8 bits,
            deinterlacing), on unusual calibrations, on robots, and on omitted frames.
        recording: file or folder of the foreign recording that was imported, or None; it may be missing.
    """

    def __init__(self, description: Description) -> None:
        self.path = description.path
        self.name = description.name
        self.scene: Scene = description.scene
        self.domains = description.domains
        self.frame_ids = description.frames.frame_ids
        self.timestamps = description.frames.timestamps
        self.matching = description.matching
        self.measured_joints = {name: arm.measured_joints for name, arm in description.arms.items()}
        times = description.frames, description.matching
        self.measured = {name: arm.measured.at_frames(*times) for name, arm in description.arms.items()}
        truth = {name: arm.truth for name, arm in description.arms.items() if arm.truth is not None}
        self.truth = {name: samples.at_frames(*times) for name, samples in truth.items()} or None
        self.remarks = description.remarks
        self.recording = description.recording
        moving = {name: camera.motion for name, camera in description.cameras.items() if camera.motion is not None}
        self._mounts = {name: np.linalg.inv(samples.at_frames(*times)) for name, samples in moving.items()}
        self._description = description
        self._cameras = description.cameras
        self._cache: ByteCache[np.ndarray] = ByteCache(CACHE_BYTES)
        self._backgrounds: dict[tuple[str, str], MeanBackground] = {}
        self._background_lock = threading.Lock()

    @staticmethod
    def open(path: Path | str, *, progress: Callable[[str], None] | None = None) -> "Sequence":
        """Read a sequence file (`docs/reference/sequence_format.md`); images are decoded on demand.

        Args:
            path: the TOML file.
            progress: called with a line of progress.

        Raises:
            SequenceError: the file, or a file that it refers to, is missing or invalid.
            RobotError: a robot or one of its meshes is missing or invalid.
        """
        # An absolute path stays valid if the working directory changes.
        return Sequence(read_description(Path(path).absolute(), progress))

    @property
    def arm_time_offsets(self) -> dict[str, float]:
        """Arm -> time offset in addition to that of `matching` [s]."""
        return {name: arm.measured.time_offset for name, arm in self._description.arms.items()}

    def with_time_offset(self, time_offset: float, *, of_arms: bool = True) -> "Sequence":
        """Sequence with the same images and joint positions at another time offset (kinematics minus image) [s], and
        without additional offsets of arms if not `of_arms`; `SequenceError` if rows are not matched by time, or the
        rows of a frame are too distant in time."""
        matching, arms = replace(self.checked_matching(), time_offset=time_offset), self._description.arms
        if not of_arms:
            arms = {name: arm.without_time_offset() for name, arm in arms.items()}
        moved = Sequence(replace(self._description, matching=matching, arms=arms))
        # Images and masks do not depend on the time offset.
        moved._cache = self._cache
        return moved

    def corrected(self, scene: Scene, measured: Mapping[str, Float[np.ndarray, "frames dofs"]]) -> "Sequence":
        """Sequence with the same images, another calibration and other joint positions of all frames [rad, m]."""
        corrected = copy(self)
        corrected.scene, corrected.measured = scene, dict(measured)
        # The background depends on the poses of the arms.
        corrected._backgrounds, corrected._background_lock = {}, threading.Lock()
        return corrected

    def missing_rows(self, offsets: Mapping[str, float]) -> list[int]:
        """Frames without rows at other time offsets [s], of `[frames]` under the empty name and of arms, as returned by
        `offsets_to_write`; `SequenceError` if rows are not matched by time."""
        matching = replace(self.checked_matching(), time_offset=offsets[""])
        return np.flatnonzero(self._description.has_missing_rows(matching, offsets)).tolist()

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __repr__(self) -> str:
        frames, cameras, domains = counted(len(self), "frame"), ", ".join(self._cameras), ", ".join(self.domains)
        return f"Sequence({self.name!r}, {frames}, cameras {cameras}, domains {domains})"

    def _repr_html_(self) -> str:
        """The first frame with the outline of the measured arms, and a table of the contents."""
        picture, sentences = None, [*self.remarks]
        try:
            picture = self._measured_picture()
            sentences.append(f"Frame {self.frame_ids[0]}, outline: measured arms (orange).")
        except SequenceError as error:
            sentences.append(str(error))
        return display(f"{self.name}: {counted(len(self), 'frame')}", picture, sentences, self._contents())

    def _measured_picture(self) -> Picture:
        from ..rendering import ImageRenderer  # noqa: PLC0415 - reading recordings requires no renderer

        camera = self.scene.cameras[0].name
        frame = self.frame(0, cameras=[camera])
        renderer = ImageRenderer(self.scene, cameras=[camera])
        state = self.scene.with_cameras([camera]).state(frame.measured, None, frame.mounts)
        return Picture(frame.images[camera], [(renderer.segment(state)[0] >= 0, MEASURED_COLOUR)])

    def _contents(self) -> list[dict[str, str]]:
        """Rows of the table of contents for notebooks."""
        cameras = [
            {
                "content": "camera",
                "name": name,
                "description": f"{entry.camera.width} x {entry.camera.height} px"
                + (", distorted" if any(entry.camera.distortion) else "")
                + (", moving" if name in self._mounts else "")
                + (", with masks" if any(self.has_masks(name, domain) for domain in self.domains) else ""),
            }
            for name, entry in self._cameras.items()
        ]
        arms = [
            {
                "content": "arm",
                "name": arm.name,
                "description": f"{arm.robot.name}, {counted(len(self.measured_joints[arm.name]), 'measured joint')}"
                + (", with ground truth" if arm.name in (self.truth or {}) else ""),
            }
            for arm in self.scene.arms
        ]
        domains = [{"content": "domain", "name": name, "description": ""} for name in self.domains]
        return [*cameras, *arms, *domains]

    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """Read a frame with the images of some cameras (all by default) in a domain (the first by default).

        Raises:
            SequenceError: there is no such frame, domain or camera, or an image is missing, damaged or of a wrong size.
        """
        if not 0 <= index < len(self):
            raise SequenceError(f"{self.path} has no frame number {index}; its frames are 0 to {len(self) - 1}.")
        domain = self._domain(domain)
        names = tuple(self._cameras) if cameras is None else tuple(cameras)
        masks = {name: mask for name in names if (mask := self._mask(name, domain, index)) is not None}
        return Frame(
            index=index,
            frame_id=self.frame_ids[index],
            domain=domain,
            images={name: self._image(name, domain, index).copy() for name in names},
            measured={arm: positions[index].copy() for arm, positions in self.measured.items()},
            truth=None if self.truth is None else {arm: rows[index].copy() for arm, rows in self.truth.items()},
            masks=masks or None,
            timestamp=None if self.timestamps is None else float(self.timestamps[index]),
            mounts=self.mounts(index),
            missing=tuple(name for name in names if index in self._camera(name).missing),
        )

    def frames_of(self, camera: str) -> list[int]:
        """Indices of the frames with an image of a camera; `SequenceError` for an unknown camera."""
        missing = self._camera(camera).missing
        return [index for index in range(len(self)) if index not in missing]

    def with_image(self, indices: Iterable[int], cameras: Iterable[str]) -> list[int]:
        """Those of the given frames with an image of at least one of the cameras; `SequenceError` for an unknown
        camera."""
        entries = [self._camera(name) for name in cameras]
        return [index for index in indices if any(index not in entry.missing for entry in entries)]

    @property
    def moving_cameras(self) -> tuple[str, ...]:
        """Names of the moving cameras."""
        return tuple(self._mounts)

    def mounts(self, index: int) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Camera -> T_mount_world of a frame [m], for moving cameras."""
        return {camera: Ts[index].copy() for camera, Ts in self._mounts.items()}

    def logged_at(self, times: Float[np.ndarray, " times"]) -> Logged:
        """Logged values at times in the clock of `[kinematics]` [s]; `SequenceError` if rows have no times."""
        self.checked_matching()
        arms = {name: arm.measured.logged_at(times) for name, arm in self._description.arms.items()}
        cameras = {name: camera.motion for name, camera in self._cameras.items() if camera.motion is not None}
        return Logged(arms, {name: motion.logged_at(times) for name, motion in cameras.items()})

    def logged_rows(self, arm: str) -> tuple[Float[np.ndarray, " rows"] | None, Float[np.ndarray, "rows dofs"]]:
        """Rows of an arm's table: times in the clock of `[kinematics]` [s], None if row n belongs to frame n, and joint
        positions [rad, m]."""
        rows = self._description.arms[arm].measured
        return None if rows.times is None else rows.times - rows.time_offset, rows.values

    def checked_matching(self) -> TimeMatching:
        """Matching of frames and rows by time; `SequenceError` if rows are not matched by time."""
        if self.matching is None:
            raise SequenceError(
                f"{self.path} has a row of joint positions for each frame, so a time offset does not apply. Give the "
                "times of the images under [frames] (docs/reference/sequence_format.md)."
            )
        return self.matching

    def recorded_camera(self, name: str) -> Camera:
        """Camera as calibrated in the sequence file, even if `corrected` replaced `scene`, with the distortion of the
        recorded images; `SequenceError` for an unknown name."""
        return self._camera(name).camera

    def image_source(self, camera: str, domain: str | None = None) -> ImageSource:
        """Source of a camera's recorded images; not cached. `SequenceError` for an unknown camera or domain."""
        return self._camera(camera).images[self._domain(domain)]

    def image_file(self, index: int, camera: str, domain: str | None = None) -> Path | None:
        """File with the pixels of a frame's image, in full bit depth; None if the image is missing, undistorted,
        cropped, rotated, or decoded from a video or a bag. `SequenceError` for an unknown camera or domain."""
        entry = self._camera(camera)
        source = entry.images[self._domain(domain)]
        changed = any(entry.camera.distortion) or index in entry.missing
        if not isinstance(source, ImageFiles) or changed or not source.upright(index):
            return None
        return source.files[index]

    def image_fingerprint(self, index: int, camera: str, domain: str | None = None) -> str:
        """Text that changes with the recorded image of a frame; the image is not decoded. Errors as in `frame`."""
        if index in self._camera(camera).missing:
            return "missing"
        return self._camera(camera).images[self._domain(domain)].fingerprint(index)

    def mask_fingerprint(self, index: int, camera: str, domain: str | None = None) -> str | None:
        """SHA-256 of the mask file of a frame; None without a mask. Errors as in `image_fingerprint`."""
        masks = self._camera(camera).masks.get(self._domain(domain))
        path = None if masks is None else masks[index]
        return None if path is None else hashlib.sha256(read_file(path)).hexdigest()

    def has_masks(self, camera: str, domain: str | None = None, index: int | None = None) -> bool:
        """Whether a camera has masks in a domain (the first by default), or a mask of the frame `index`."""
        masks = self._camera(camera).masks.get(self._domain(domain))
        return masks is not None and (index is None or masks[index] is not None)

    def background(self, camera: str, domain: str | None = None) -> UInt8[np.ndarray, "height width 3"]:
        """Mean background BG_m: undistorted image of the camera without arms, RGB.

        It is the image given in the sequence file, else the median over the recording, excluding pixels covered by the
        arms at their measured positions. The first call may take seconds.

        Raises:
            SequenceError: there is no such domain or camera, or an image is not usable.
        """
        return self.mean_background(camera, domain).image.copy()

    def forget_images(self) -> None:
        """Remove decoded images and masks from the cache."""
        self._cache.clear()

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Background with its known pixels and reliability; errors are those of `background`."""
        domain = self._domain(domain)
        with self._background_lock:
            if (camera, domain) not in self._backgrounds:
                self._backgrounds[camera, domain] = self._make_background(self._camera(camera), domain)
            return self._backgrounds[camera, domain]

    def _make_background(self, entry: CameraInput, domain: str) -> MeanBackground:
        camera = entry.camera
        if domain in entry.background:
            path = entry.background[domain]
            image = read_image(path, getattr(entry.images[domain], "bits", None))
            self._check_size(image, camera.name, f"background {path}")
            return MeanBackground(camera.undistort(image), np.ones(image.shape[:2], bool))
        present = self.frames_of(camera.name)
        indices = [present[place] for place in evenly_spaced(len(present))]
        states = [
            self.scene.state({arm: rows[index] for arm, rows in self.measured.items()}, None, self.mounts(index))
            for index in indices
        ]
        try:
            found = background_of_recording(
                self.scene, camera.name, states, lambda place: self._image(camera.name, domain, indices[place])
            )
        except SequenceError as error:
            raise SequenceError(f"{self.path}: camera {camera.name!r}: {error}") from error
        if camera.name not in self._mounts:
            return found
        problem = f"camera {camera.name!r} moves, so the background differs between frames, and none is used."
        return replace(found, known=np.zeros_like(found.known), problem=problem)

    def _image(self, camera: str, domain: str, index: int) -> np.ndarray:
        entry = self._camera(camera)

        def decode() -> np.ndarray:
            if index in entry.missing:
                return np.zeros((entry.camera.height, entry.camera.width, 3), np.uint8)
            image = (source := entry.images[domain]).read(index)
            self._check_size(image, camera, f"image {source.name(index)}")
            return entry.camera.undistort(image)

        return self._cache.get(("image", camera, domain, index), decode)

    def _mask(self, camera: str, domain: str, index: int) -> np.ndarray | None:
        entry = self._camera(camera)
        path = entry.masks[domain][index] if domain in entry.masks else None
        if path is None:
            return None

        def decode() -> np.ndarray:
            mask = read_mask(path)
            self._check_size(mask, camera, f"mask {path}")
            return entry.camera.undistort(mask)

        return self._cache.get(("mask", camera, str(path)), decode).copy()

    def _check_size(self, image: np.ndarray, camera: str, what: str) -> None:
        height, width = image.shape[:2]
        wanted = self._camera(camera).camera
        if (width, height) != (wanted.width, wanted.height):
            raise SequenceError(
                f"{what} has {width} x {height} pixels, but camera {camera!r} has {wanted.width} x {wanted.height} "
                f"({self.path}). Correct `size` and K there, or export the file at the size of the camera."
            )

    def _domain(self, domain: str | None) -> str:
        return self.domains[0] if domain is None else self._known(domain, "domain", self.domains)

    def _camera(self, camera: str) -> CameraInput:
        return self._cameras[self._known(camera, "camera", self._cameras)]

    def _known(self, name: str, what: str, known: Collection[str]) -> str:
        if name not in known:
            listing = ", ".join(known)
            raise SequenceError(
                f"{self.path} has no {what} {name!r}.{closest(name, known)} Its {what}s are: {listing}."
            )
        return name


AHEAD = 8
"""Maximum number of frames to prefetch in the direction of travel."""
MAX_STRIDE = 10
"""Maximum step between frames from which the direction of travel is inferred."""


class FrameReader:
    """Reads frames and prefetches their neighbours in the direction of travel into the sequence's cache, on a thread.

    Each call of `frame` replaces the queue. Errors of prefetched frames are ignored, since reading these frames
    raises them again. The thread ends when the queue is empty.
    """

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._lock = threading.Lock()
        self._plan: deque[tuple[int, str, tuple[str, ...]]] = deque()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._last: int | None = None
        self._stride = 1

    def frame(self, index: int, domain: str, *cameras: str) -> Frame:
        """Read a frame with the images of some cameras; errors are those of `Sequence.frame`."""
        self._replace_plan(())
        frame = self._sequence.frame(index, domain, list(cameras))
        moved = 0 if self._last is None else index - self._last
        self._last = index
        if moved:
            self._stride = moved if abs(moved) <= MAX_STRIDE else 1
        self._replace_plan((row, domain, cameras) for row in self._neighbours(index, cameras))
        return frame

    def close(self) -> None:
        """Stop prefetching and wait for the thread; `frame` still works."""
        with self._lock:
            self._closed = True
            self._plan.clear()
            thread = self._thread
        if thread is not None:
            thread.join()

    def _neighbours(self, index: int, cameras: Collection[str]) -> list[int]:
        """Numbers of the frames to prefetch, the most probable first."""
        sizes = [own.width * own.height for own in self._sequence.scene.cameras if own.name in cameras]
        # Prefetched images and masks use at most half of the cache, so that recent frames stay cached.
        ahead = min(AHEAD, CACHE_BYTES // 2 // max(4 * sum(sizes), 1))
        rows = [index + self._stride * count for count in range(1, ahead + 1)] + [index - self._stride]
        return [row for row in rows if 0 <= row < len(self._sequence)]

    def _replace_plan(self, plan: Iterable[tuple[int, str, tuple[str, ...]]]) -> None:
        with self._lock:
            self._plan = deque(() if self._closed else plan)
            if self._plan and self._thread is None:
                self._thread = threading.Thread(target=self._read, name="carts-frames", daemon=True)
                self._thread.start()

    def _read(self) -> None:
        while True:
            with self._lock:
                if not self._plan:
                    self._thread = None
                    return
                index, domain, cameras = self._plan.popleft()
            try:
                self._sequence.frame(index, domain, list(cameras))
            except Exception:  # Reading the frame again raises the error again.
                continue
