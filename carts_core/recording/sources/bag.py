"""ROS 1 and ROS 2 bags with topics of the dVRK (1.x, 2.0, 2.2 and later) or of simulators that use CRTK."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...model import ecm_kinematics
from ...model.psm_kinematics import JOINT_NAMES
from ..image_sources import BAG_SUFFIXES, Bag, decode_message
from ..importing.cameras import calibration_of, camera_from_info, cameras_of, common_ids, find_images, side_of, sides_of
from ..importing.columns import has_unknown_names, order_of_names, track_of
from ..importing.found import FoundCamera, FoundRecording, Import, PartError, Source, Track, recording_name
from ..importing.logs import ArmLog, arm_from_log, endoscope_motion, nearest
from ..importing.row_matching import frame_times

_POSES = ("local/measured_cp", "position_cartesian_local_current", "measured_cp", "position_cartesian_current")
_JOINTS = ("measured_js", "state_joint_current")


def read_endoscope(bag: Bag, start: float, job: Import) -> Track | None:
    """Motion of the endoscope relative to its pose at `start`, the time of the first image [s]; None if it is static or
    not recorded."""
    topics = [topic for topic, _ in bag.topics if "/suj/" not in topic.casefold()]
    for role, names in (("poses", _POSES), ("joints", _JOINTS)):
        endings = [f"/ecm/{name}" for name in names]
        found = next((topic for end in endings for topic in topics if topic.casefold().endswith(end)), None)
        if found is not None:
            logged = track_of(bag.rows({found: ("ecm", role)}).get("ecm", []), role, ecm_kinematics.JOINT_NAMES)
            poses, joints = (logged, None) if role == "poses" else (None, logged)
            return endoscope_motion(poses, joints, start, job)
    return None


def _guessed_offset(times: Float[np.ndarray, " frames"], arms: list[ArmLog], job: Import) -> float:
    """Kinematics time minus time of image files [s]: 0 for overlapping clocks, else from a common start."""
    known = (log.joints or log.local_poses or log.poses for log in arms)
    logs = [logged.times for logged in known if logged is not None]
    apart = bool(logs) and (times[0] > max(log[-1] for log in logs) or times[-1] < min(log[0] for log in logs))
    offset = float(max(log[0] for log in logs) - times[0]) if apart else 0.0
    text = "the clocks do not overlap; a common start of images and kinematics is assumed" if offset else "0 s"
    job.guessed(f"time offset: {text}.", option="--time-offset")
    return offset


def _separate_images(
    path: Path, topics: list[str], job: Import
) -> tuple[tuple[FoundCamera, ...], tuple[str, ...], Float[np.ndarray, " frames"]] | None:
    """Cameras, frame ids and times [s] of images given as files; None if no files are given."""
    given, files = job.options.images, {}
    for name, image in given.items():
        beside = [place for place in (Path(image), path.parent / image) if os.path.exists(place)]
        if image not in topics and beside:
            files[name] = beside[0]
    if not files:
        return None
    if len(files) < len(given):
        raise SequenceError("some images are topics of the bag, others are files. Choose topics only or files only.")
    images = {name: find_images(place) for name, place in files.items()}
    ids = common_ids(images, path)
    first = next(iter(images.values()))
    times = frame_times(first, ids, job).times
    if times is None:
        problem = f"images in {first.path} have no times. Give their frame rate."
        raise PartError("columns", problem, "Use --frame-rate.")
    return cameras_of(images, job), ids, times


_ARM_TOPIC = re.compile(r"^(?P<prefix>/|.*/)(?P<arm>PSM\d?)/(?P<rest>.+)$", re.IGNORECASE)
_ROLES = {
    **dict.fromkeys(("measured_js", "state_joint_current"), "joints"),
    **dict.fromkeys(("jaw/measured_js", "state_jaw_current"), "jaw"),
    **dict.fromkeys(("measured_cp", "position_cartesian_current"), "poses"),
    **dict.fromkeys(("local/measured_cp", "position_cartesian_local_current"), "local_poses"),
    "tool_type": "tool",
}
_KINDS = {"joints": "joints", "jaw": "jaw", "tool": "text"}
_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_PREFERRED = ("rect", "compressed", "")


def read_arm_logs(bag: Bag, job: Import) -> list[ArmLog]:
    """Read the logs of the arms in a bag; notes report joints in another order or with unknown names."""
    wanted: dict[str, tuple[str, str]] = {}
    names = {recorded.casefold(): name for name, recorded in job.options.arms.items()}
    seen: set[str] = set()
    arms: set[str] = set()
    for topic, _ in bag.topics:
        match = _ARM_TOPIC.match(topic)
        role = _role(match) if match else None
        if match is None or role is None:
            continue
        recorded = match["arm"]
        seen.add(recorded)
        if names and recorded.casefold() not in names:
            continue
        arm = names.get(recorded.casefold(), recorded.upper())
        arms.add(arm)
        wanted[topic] = (f"{arm} {role}", _KINDS.get(role, "pose"))
    known = {recorded.casefold() for recorded in seen}
    if missing := [recorded for recorded in job.options.arms.values() if recorded.casefold() not in known]:
        raise SequenceError(f"{bag.path} has no arm {missing[0]!r}. It has: {', '.join(sorted(seen)) or 'none'}.")
    found = bag.rows(wanted)
    logs = []
    for arm in sorted(arms):
        logged = {role: found[f"{arm} {role}"] for role in {*_ROLES.values(), "setup"} if f"{arm} {role}" in found}
        for each in sorted({tuple(names) for names, _ in logged.get("joints", ())}):
            _note_names(arm, each, job)
        tracks: dict[str, Any] = {role: track_of(rows, role) for role, rows in logged.items() if role != "tool"}
        if logged:
            logs.append(ArmLog(arm, tool=logged.get("tool", ""), **tracks))
    return logs


def _note_names(arm: str, names: tuple[str, ...], job: Import) -> None:
    """Report joints in another order or with other names."""
    order = order_of_names(names)
    if order is not None and order != tuple(range(len(JOINT_NAMES))):
        job.found(f"joint positions are in the order {', '.join(names)}; joints are matched by name.", arm)
    elif has_unknown_names(names):
        text = f"{', '.join(names)} are not joints of a PSM; the order {', '.join(JOINT_NAMES)} is assumed."
        job.warning(text, arm)


def _role(match: re.Match[str]) -> str | None:
    if match["prefix"].rstrip("/").endswith("SUJ"):
        return "setup" if match["rest"] == "measured_cp" else None
    return _ROLES.get(match["rest"])


def _image_topics(bag: Bag) -> list[str]:
    return list(dict.fromkeys(topic for topic, kind in bag.topics if kind in _IMAGE_TYPES))


def _chosen_topics(bag: Bag, given: Mapping[str, str]) -> dict[str, str]:
    """Camera -> topic."""
    path, topics = bag.path, _image_topics(bag)
    for topic in given.values():
        if topic not in topics:
            raise SequenceError(f"{path} has no image topic {topic!r}. It has: {', '.join(topics) or 'none'}.")
    if given:
        return dict(given)
    chosen: dict[str, list[str]] = {}
    for topic in topics:
        chosen.setdefault(side_of(topic) or ("camera" if len(topics) == 1 else topic), []).append(topic)
    unknown = [name for name in chosen if name.startswith("/")]
    if unknown and len(unknown) < len(chosen):
        chosen = {name: found for name, found in chosen.items() if name not in unknown}
    elif len(unknown) > 1:
        raise PartError(
            "images",
            f"{path} has {len(topics)} image topics, whose names contain neither left nor right: {', '.join(topics)}.",
            "Choose: --images left TOPIC right TOPIC.",
        )

    def preference(topic: str) -> int:
        return next(rank for rank, word in enumerate(_PREFERRED) if word in topic)

    return {name: min(found, key=preference) for name, found in chosen.items()}


def _cameras(bag: Bag, job: Import) -> tuple[tuple[FoundCamera, ...], np.ndarray]:
    path, topics = bag.path, _chosen_topics(bag, job.options.images)
    times = {name: bag.image_times(topic) for name, topic in topics.items()}
    for name, topic in topics.items():
        if not len(times[name][0]):
            problem = f"{path}: topic {topic} has no messages."
            raise PartError("images", problem, f"Choose another one: --images {name} TOPIC.")
    if not topics:
        return (), np.empty(0)
    leader, *others = sorted(topics, key=lambda name: (name != "left", name))
    frame_times = times[leader][1]
    order = np.argsort(frame_times, kind="stable")
    frame_times = frame_times[order]
    cameras, sides = [], sides_of((leader, *others))
    for name in (leader, *others):
        record, stamps = times[name]
        chosen = order if name == leader else nearest(frame_times, stamps)
        if name != leader and (late := np.abs(stamps[chosen] - frame_times).max()) > 0.02:
            job.warning(f"times of images differ by up to {late:.3f} s from those of {leader}.", name)
        first = decode_message(bag.message(topics[name]), f"{path}, {topics[name]}")
        size = (first.shape[1], first.shape[0])
        camera = FoundCamera(name, size, path, topic=topics[name], numbers=record[chosen])
        if name not in job.options.calibration:
            camera = camera_from_info(camera, _camera_info(bag, topics[name]), job)
        cameras.append(calibration_of(camera, job, sides[name]))
        job.found(f"{topics[name]}, {len(record)} images, {size[0]} x {size[1]}.", name)
    return tuple(cameras), frame_times


def _camera_info(bag: Bag, topic: str) -> Any:
    """The camera_info of an image topic, from the same namespace or of the same side; None if not found."""
    infos = [info for info, kind in bag.topics if kind == _INFO_TYPE]
    parents = [topic.rsplit("/", depth)[0] for depth in (1, 2, 3)]
    chosen = [info for parent in parents for info in infos if info.rsplit("/", 1)[0] == parent]
    side = side_of(topic)
    chosen += [info for info in infos if side is not None and side_of(info) == side]
    return bag.message(chosen[0]) if chosen else None


def _read(path: Path, job: Import) -> FoundRecording:
    with Bag(path) as bag:
        if not bag.topics:
            raise SequenceError(f"bag {path} has no messages. Record again, or copy it again.")
        beside = _separate_images(path, _image_topics(bag), job)
        if beside is None:
            if job.options.frame_rate is not None:
                problem = "a frame rate is not used, since the images of the bag have times. Leave it out."
                raise PartError("columns", problem, "Use --frame-rate.")
            cameras, frame_times = _cameras(bag, job)
            ids = tuple(f"{number:06d}" for number in range(len(frame_times)))
        else:
            cameras, ids, frame_times = beside
        logs = read_arm_logs(bag, job)
        if not logs:
            known = ", ".join(sorted(topic for topic, _ in bag.topics))
            raise SequenceError(
                f"bag {path} has no kinematics of an arm (looked for /PSM1/measured_js, /PSM1/measured_cp and the "
                f"names of dVRK 1.x). Its topics are: {known}."
            )
        offset = job.options.time_offset
        if offset is None:
            offset = 0.0 if beside is None else _guessed_offset(frame_times, logs, job)
        start = float(frame_times[0]) + offset if len(frame_times) else None
        motion = None if start is None else read_endoscope(bag, start, job)
        arms = [arm_from_log(log, job, start, motion) for log in logs]
    name, kind = recording_name(path), "a ROS bag"
    return job.recording(kind, name, cameras, arms, ids, frame_times, time_offset=offset, motion=motion)


SOURCE = Source(
    "bag",
    "a ROS 1 or ROS 2 bag",
    "a file .bag or .mcap, or a folder with metadata.yaml",
    lambda path: (path.suffix in BAG_SUFFIXES and path.is_file()) or (path / "metadata.yaml").is_file(),
    ("images", "time_offset", "frame_rate"),
    _read,
)
