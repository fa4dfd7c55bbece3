"""ROS 1 and ROS 2 bags with topics of the dVRK: 1.x, 2.0, 2.2 and later, and of simulators that speak CRTK."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...model import ecm_kinematics
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.interchange import ImportOptions
from ..image_sources import BAG_SUFFIXES, Bag, decode_message
from ..importing.cameras import calibration_of, camera_from_info, cameras_of, common_ids, find_images, side_of
from ..importing.columns import order_of_names, rows_of, strange_names
from ..importing.found import FoundArm, FoundCamera, FoundMotion, FoundRecording, Note, Notes, Source, recording_name
from ..importing.logs import ArmLog, arm_from_log, endoscope_motion, nearest, track
from ..importing.row_matching import frame_times

_POSES = ("local/measured_cp", "position_cartesian_local_current", "measured_cp", "position_cartesian_current")
_JOINTS = ("measured_js", "state_joint_current")


def read_endoscope(bag: Bag, start: float, notes: Notes) -> FoundMotion | None:
    """Motion of the endoscope; None if it is static.

    Args:
        bag: the recording.
        start: time of the first image [s].
        notes: of the import; some are added.

    Raises:
        SequenceError: a message is damaged.
    """
    for role, names in (("poses", _POSES), ("joints", _JOINTS)):
        found = next((topic for name in names for topic, _ in bag.topics if _is_of_ecm(topic, name)), None)
        if found is None:
            continue
        logged = track(rows_of(bag.rows({found: ("ecm", role)}).get("ecm", []), role, ecm_kinematics.JOINT_NAMES))
        return (
            endoscope_motion(logged, None, start, notes)
            if role == "poses"
            else endoscope_motion(None, logged, start, notes)
        )
    return None


def _is_of_ecm(topic: str, name: str) -> bool:
    return topic.casefold().endswith(f"/ecm/{name}") and "/suj/" not in topic.casefold()


@dataclass(frozen=True, eq=False)
class SeparateImages:
    """Cameras whose images are files, and the frames that all of them have."""

    cameras: tuple[FoundCamera, ...]
    ids: tuple[str, ...]
    times: Float[np.ndarray, " frames"]
    """Times in the clock of the images [s]."""

    def offset(self, arms: tuple[FoundArm, ...], notes: Notes) -> float:
        """Default time in the kinematics minus time of the images [s]: 0 for overlapping clocks, else with a common
        start."""
        begin = [float(arm.times[0]) for arm in arms if arm.times is not None]
        end = [float(arm.times[-1]) for arm in arms if arm.times is not None]
        apart = not begin or self.times[0] > max(end) or self.times[-1] < min(begin)
        offset = max(begin) - float(self.times[0]) if begin and apart else 0.0
        text = "the clocks do not overlap: images and kinematics are taken to begin together" if offset else "0 s"
        notes.guessed(f"time offset: {text} (change: --time-offset).")
        return offset


def separate_images(path: Path, topics: list[str], options: ImportOptions, notes: Notes) -> SeparateImages | None:
    """Images given as files or folders; None if none are given or they are topics of the bag.

    Args:
        path: of the bag; names are relative to where the command is run, or to its folder.
        topics: of its images.
        options: with the names.
        notes: of the import; some are added.

    Raises:
        SequenceError: some are topics and some are files, they have no times, or cannot be read.
    """
    places = {name: _place(path, given) for name, given in options.images.items() if given not in topics}
    files: Mapping[str, Path] = {name: place for name, place in places.items() if place is not None}
    if not files:
        return None
    if len(files) < len(options.images):
        raise SequenceError("images are either all topics of the bag or all files beside it. Name one kind.")
    images = {name: find_images(place) for name, place in files.items()}
    ids = common_ids(list(images.values()))
    if not ids:
        raise SequenceError(f"{path}: no frame has an image of every camera. Number them alike, or import one camera.")
    first = next(iter(images.values()))
    times = frame_times(first, ids, options, notes).times
    if times is None:
        raise SequenceError(f"images in {first.path} have no times. Say how many there are a second: --frame-rate.")
    return SeparateImages(cameras_of(images, options, notes), ids, times)


def _place(path: Path, given: str) -> Path | None:
    return next((place for place in (Path(given), path.parent / given) if os.path.exists(place)), None)


_ARM_TOPIC = re.compile(r"^(?P<prefix>/|.*/)(?P<arm>PSM\d?)/(?P<rest>.+)$", re.IGNORECASE)
_ROLES = {
    "measured_js": "joints",
    "state_joint_current": "joints",
    "jaw/measured_js": "jaw",
    "state_jaw_current": "jaw",
    "measured_cp": "poses",
    "position_cartesian_current": "poses",
    "local/measured_cp": "local_poses",
    "position_cartesian_local_current": "local_poses",
    "tool_type": "tool",
}
_KINDS = {"joints": "joints", "jaw": "jaw", "tool": "text"}
_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_PREFERRED = ("rect", "compressed", "")


def _detect(path: Path) -> bool:
    return (path.suffix in BAG_SUFFIXES and path.is_file()) or (path / "metadata.yaml").is_file()


def read_arm_logs(bag: Bag, options: ImportOptions, notes: Notes) -> list[ArmLog]:
    """Logs of the arms in a bag by name; notes report joints in another order.

    Raises:
        SequenceError: a message is damaged, or an arm that was asked for is not there.
    """
    wanted: dict[str, tuple[str, str]] = {}
    names = {recorded.casefold(): name for name, recorded in options.arms.items()}
    seen: set[str] = set()
    arms: set[str] = set()
    for topic, _ in bag.topics:
        match = _ARM_TOPIC.match(topic)
        role = _role(match) if match else None
        if match is None or role is None:
            continue
        recorded = match["arm"]
        seen.add(recorded)
        if options.arms and recorded.casefold() not in names:
            continue
        arm = names.get(recorded.casefold(), recorded.upper())
        arms.add(arm)
        wanted[topic] = (f"{arm} {role}", _KINDS.get(role, "pose"))
    if missing := [
        recorded for recorded in options.arms.values() if recorded.casefold() not in map(str.casefold, seen)
    ]:
        raise SequenceError(f"{bag.path} has no arm {missing[0]!r}. It has: {', '.join(sorted(seen)) or 'none'}.")
    found = bag.rows(wanted)
    logs = []
    for arm in sorted(arms):
        logged = {role: found[f"{arm} {role}"] for role in {*_ROLES.values(), "setup"} if f"{arm} {role}" in found}
        names = sorted({tuple(names) for names, _ in logged.get("joints", ())})
        notes += [note for each in names if (note := _note_on_names(arm, each)) is not None]
        tracks = {role: track(rows_of(rows, role, JOINT_NAMES)) for role, rows in logged.items() if role != "tool"}
        given = [tracks.get(role) for role in ("joints", "jaw", "poses", "local_poses", "setup")]
        if logged:
            logs.append(ArmLog(arm, *given, tool=logged.get("tool", "")))
    return logs


def _note_on_names(arm: str, names: tuple[str, ...]) -> Note | None:
    order = order_of_names(names)
    if order is not None and order != tuple(range(len(JOINT_NAMES))):
        return Note("found", f"{arm}: joint positions are in the order {', '.join(names)}; they are taken by name.")
    if strange_names(names):
        text = f"{arm}: joints are called {', '.join(names)}, which says nothing of a PSM; they are taken in the order"
        return Note("warning", f"{text} {', '.join(JOINT_NAMES)}.")
    return None


def _role(match: re.Match[str]) -> str | None:
    if match["prefix"].rstrip("/").endswith("SUJ"):
        return "setup" if match["rest"] == "measured_cp" else None
    return _ROLES.get(match["rest"])


def _image_topics(bag: Bag) -> list[str]:
    return list(dict.fromkeys(topic for topic, kind in bag.topics if kind in _IMAGE_TYPES))


def _chosen_topics(bag: Bag, options: ImportOptions) -> dict[str, str]:
    """Camera -> topic."""
    path, topics = bag.path, _image_topics(bag)
    if options.images:
        for topic in options.images.values():
            if topic not in topics:
                raise SequenceError(f"{path} has no image topic {topic!r}. It has: {', '.join(topics) or 'none'}.")
        return dict(options.images)
    chosen: dict[str, list[str]] = {}
    for topic in topics:
        chosen.setdefault(side_of(topic) or ("camera" if len(topics) == 1 else topic), []).append(topic)
    unknown = [name for name in chosen if name.startswith("/")]
    if unknown and len(unknown) < len(chosen):
        chosen = {name: found for name, found in chosen.items() if name not in unknown}
    elif len(unknown) > 1:
        raise SequenceError(
            f"{path} has {len(topics)} image topics, whose names do not say which camera they are: "
            f"{', '.join(topics)}. Choose: --images left TOPIC right TOPIC."
        )
    return {name: min(found, key=_preference) for name, found in chosen.items()}


def _preference(topic: str) -> int:
    return next(rank for rank, word in enumerate(_PREFERRED) if word in topic)


def _cameras(bag: Bag, options: ImportOptions, notes: Notes) -> tuple[tuple[FoundCamera, ...], np.ndarray]:
    path, topics = bag.path, _chosen_topics(bag, options)
    times = {name: bag.image_times(topic) for name, topic in topics.items()}
    for name, topic in topics.items():
        if not len(times[name][0]):
            raise SequenceError(f"{path}: topic {topic} has no messages. Choose another one: --images {name} TOPIC.")
    leader = next(iter(sorted(topics, key=lambda name: (name != "left", name))), None)
    if leader is None:
        return (), np.empty(0)
    frame_times = times[leader][1]
    order = np.argsort(frame_times, kind="stable")
    frame_times = frame_times[order]
    cameras = []
    for name in sorted(topics, key=lambda name: (name != leader, name)):
        record, stamps = times[name]
        chosen = order if name == leader else nearest(frame_times, stamps)
        if name != leader and (late := np.abs(stamps[chosen] - frame_times).max()) > 0.02:
            notes.warning(f"images of {name} are up to {late:.3f} s from those of {leader}.")
        info = _camera_info(bag, topics[name])
        first = decode_message(bag.message(topics[name]), f"{path}, {topics[name]}")
        size = (first.shape[1], first.shape[0])
        numbers = record[chosen]
        camera = FoundCamera(name, size, path)
        found = camera_from_info(camera, info, options, notes, rectified="rect" in topics[name])
        cameras.append(calibration_of(found, options, notes, topic=topics[name], numbers=numbers))
        notes.found(f"camera {name}: {topics[name]}, {len(record)} images, {size[0]} x {size[1]}.")
    return tuple(cameras), frame_times


def _camera_info(bag: Bag, topic: str) -> Any:
    """The camera_info of an image topic: beside it, or of the same side; None without one."""
    infos = [info for info, kind in bag.topics if kind == _INFO_TYPE]
    parents = [topic.rsplit("/", depth)[0] for depth in (1, 2, 3)]
    chosen = [info for parent in parents for info in infos if info.rsplit("/", 1)[0] == parent]
    side = side_of(topic)
    chosen += [info for info in infos if side is not None and side_of(info) == side]
    return bag.message(chosen[0]) if chosen else None


def _read(path: Path, options: ImportOptions) -> FoundRecording:
    with Bag(path) as bag:
        if not bag.topics:
            raise SequenceError(f"bag {path} has no messages. Record again, or copy it again.")
        notes = Notes()
        beside = separate_images(path, _image_topics(bag), options, notes)
        if beside is None:
            if options.frame_rate is not None:
                raise SequenceError("--frame-rate is not used: the images of the bag have times. Leave it out.")
            cameras, frame_times = _cameras(bag, options, notes)
            ids = tuple(f"{number:06d}" for number in range(len(frame_times)))
        else:
            cameras, frame_times, ids = beside.cameras, beside.times, beside.ids
        logs = read_arm_logs(bag, options, notes)
        if not logs:
            known = ", ".join(sorted(topic for topic, _ in bag.topics))
            raise SequenceError(
                f"bag {path} has no kinematics of an arm (looked for /PSM1/measured_js, /PSM1/measured_cp and the "
                f"names of dVRK 1.x). Its topics are: {known}."
            )
        arms = tuple(arm_from_log(log, options, notes) for log in logs)
        offset = options.time_offset
        if offset is None:
            offset = 0.0 if beside is None else beside.offset(arms, notes)
        first = float(frame_times[0]) + offset if len(frame_times) else 0.0
        motion = read_endoscope(bag, first, notes) if len(frame_times) else None
    name = recording_name(path)
    return FoundRecording("a ROS bag", name, cameras, arms, ids, frame_times, tuple(notes), offset, motion)


SOURCE = Source(
    "bag",
    "ROS 1 or ROS 2 bag",
    "a file .bag or .mcap, or a folder with metadata.yaml",
    _detect,
    ("images", "time_offset", "frame_rate"),
    _read,
)
