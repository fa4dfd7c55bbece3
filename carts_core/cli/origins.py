"""What a result of `carts optimize` was made from, and what of that has changed since."""

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Indices

import numpy as np

from ..fingerprints import calibration_fingerprint, code_fingerprint, fingerprint, robot_fingerprint
from ..recording import Frame, Sequence
from .observing import Observer

Origin = Mapping[str, str]
"""Kind of input -> its fingerprint; the kinds are those of `_CHANGED`."""

_CHANGED = {
    "code": "another version of the program made them",
    "weights": "the weights changed",
    "settings": "the settings changed",
    "robot": "the robot changed",
    "calibration": "the calibration changed",
    "joints": "the measured joint positions changed",
    "images": "the images changed",
    "masks": "the masks changed",
    "background": "the background changed",
    "together": "they were solved together with other frames",
}
"""What to say where the fingerprint of an input is another one."""

_CODE = (
    "*.py",
    "imaging/**/*.py",
    "model/**/*.py",
    "recording/*.py",
    "evaluation/evaluate.py",
    "evaluation/sequence.py",
    "export/kinematics.py",
    "export/png.py",
    "networks/**/*.py",
    "optimization/**/*.py",
    "rendering/**/*.py",
)


class Origins:
    """Fingerprints of what frames are made from, as some cameras see them in a domain.

    Args:
        sequence, cameras: whose frames these are.
        observer: who says what images show.
        load: the frame at a position, its `measured` where the optimization starts.
        backgrounds: camera name -> mean background that frames are compared with, where there is one.
        settings: what was asked for, as JSON.
    """

    def __init__(
        self,
        sequence: Sequence,
        cameras: tuple[str, ...],
        observer: Observer,
        load: Callable[[int], Frame],
        backgrounds: Mapping[str, np.ndarray],
        settings: str,
    ) -> None:
        self._sequence, self._load, self._observer = sequence, load, observer
        recorded = [sequence.recorded_camera(name) for name in cameras]
        self._common = {
            "code": code_fingerprint(_CODE),
            "weights": fingerprint(observer.weights, str(observer.predictor.device)),
            "settings": fingerprint(settings),
            "robot": fingerprint(*(robot_fingerprint(arm.robot) for arm in sequence.scene.arms)),
            "calibration": calibration_fingerprint(sequence.scene, recorded),
            "background": fingerprint([(name, backgrounds[name]) for name in sorted(backgrounds)]),
        }

    @property
    def common(self) -> Origin:
        """What all frames have in common."""
        return self._common

    def of(self, index: int) -> Origin:
        """Of a frame that is corrected alone.

        Raises:
            SequenceError: one of its images cannot be read.
        """
        frame = self._load(index)
        arms = self._sequence.measured
        joints = [(name, frame.measured[name], arms[name][index]) for name in sorted(frame.measured)]
        joints += sorted(frame.mounts.items())
        images = [(name, frame.images[name]) for name in sorted(frame.images)]
        origin = {**self._common, "joints": fingerprint(joints), "images": fingerprint(images)}
        return origin | ({"masks": fingerprint(self._observer.inputs(frame))} if self._observer.masked else {})

    def of_all(self, indices: Indices[int]) -> Origin:
        """Of frames that are corrected together: each depends on what all are made from."""
        each = [self.of(index) for index in indices]
        stamps = self._sequence.timestamps
        times = [None if stamps is None else float(stamps[index]) for index in indices]
        masks = {"masks": fingerprint(*(origin["masks"] for origin in each))} if self._observer.masked else {}
        return {
            **self._common,
            **masks,
            "joints": fingerprint(*(origin["joints"] for origin in each)),
            "images": fingerprint(*(origin["images"] for origin in each)),
            "together": fingerprint(indices, [self._sequence.frame_ids[index] for index in indices], repr(times)),
        }


def changes(before: Origin, now: Origin) -> str | None:
    """What has changed, for people; None if nothing that both tell of has."""
    different = [kind for kind in _CHANGED if kind in now and before.get(kind) != now[kind]]
    if "together" in different:
        # With other frames, these are of other frames too.
        different = [kind for kind in different if kind not in ("joints", "images", "masks")]
    if "calibration" in different:
        # Images are compared without their distortion, which belongs to the calibration.
        different = [kind for kind in different if kind not in ("images", "masks", "background")]
    if "joints" in different or "images" in different:
        # A background is made from frames.
        different = [kind for kind in different if kind != "background"]
    return " and ".join(_CHANGED[kind] for kind in different) or None
