"""Sources of frames: a held-out synthetic sequence, a given real sequence, other rooms and instruments."""

import hashlib
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...errors import SettingsError
from ...files import holds_file, output_path
from ...files.reading import IMAGE, SEQUENCE, read_bytes
from ...model.mesh_cache import cache_dir
from ...recording import Sequence
from ...recording.background import evenly_spaced
from ...settings import DOMAINS, EndoscopeConfig, MotionConfig, RenderConfig, SynthesisConfig
from ...wording import counted
from ..synthesis.scene import place_cameras
from ..synthesis.synthesize import Progress, synthesize
from .counterfactual import Counterfactual, backdrop
from .measurement import code_fingerprint
from .rooms import AlteredSequence, AnotherRoom, Room, photographs, synthetic_rooms
from .scope import FAMILY, REAL, ROOMS, SYNTHETIC, Scope

TEST_SEED = 730_511
"""Seed of the synthetic sequence, reserved for the benchmark."""
HELD_OUT = ("curved_scissors", "clip_applier")
"""Built-in instruments absent from the training data."""
_FAMILY_DOMAINS = ("regular", "smoke")
_MOTION_SECONDS = 6.0
_SYNTHESIS = ("lab/synthesis/*.py", "settings/synthesis.py", "templates/synthetic_sequence.toml")
_ROOMS_CODE = ("lab/benchmark/rooms.py",)
_ALTERING_CODE = ("lab/benchmark/counterfactual.py",)


Recording = Sequence | AlteredSequence


@dataclass(frozen=True)
class Source:
    """Source of evaluated frames, opened or rendered on demand by `open`."""

    name: str
    """Name as in `Run.source`."""
    description: str
    """Description for the report."""
    camera: str
    """Camera that is optimized and scored."""
    frames: list[int]
    """Indices of the frames on which all methods are evaluated."""
    fingerprint: str
    """Fingerprint of images and kinematics."""
    open: Callable[[Progress], Recording]
    cameras: tuple[str, ...] = ()
    """All cameras with images of the regular domain."""
    consecutive: list[int] = field(default_factory=list)
    """Indices of frames that are corrected together."""
    rooms: list[str] = field(default_factory=list)
    """Names of the rooms of a source with frames in other rooms."""
    domains: tuple[str, ...] = DOMAINS
    """Synthetic domains of the source."""
    length: int = 1
    """Number of frames of the whole recording."""

    @property
    def further(self) -> list[int]:
        """Indices of frames that are corrected together but not evaluated by all methods."""
        return [index for index in self.consecutive if index not in self.frames]


def synthetic_source(scope: Scope, seed: int = TEST_SEED) -> Source:
    """Source with a synthetic sequence, which is rendered into the cache when first opened.

    Raises:
        SettingsError: the seed is the seed of the shipped sequence.
    """
    if seed == SynthesisConfig().seed:
        raise SettingsError(
            f"--seed {seed} is the seed of the shipped sequence, on which settings were tuned. Use another seed; the "
            f"default is {TEST_SEED}."
        )
    frames = scope.sequence_frames
    config = _config(scope, seed, f"fresh {seed}", frames, endoscope=EndoscopeConfig(stereo=True))
    evaluated = evenly_spaced(frames, scope.frames)
    what = f"seed {seed}: two arms, {config.endoscope.width}x{config.endoscope.height}"
    used = f"all methods evaluated on {len(evaluated)} of {counted(frames, 'frame')}"
    taken = f"{used}, {counted(scope.samples, 'path')} per pixel"
    return Source(
        SYNTHETIC,
        f"{what}, {taken}",
        "left",
        evaluated,
        *_made_once(config),
        cameras=tuple(camera.name for camera in place_cameras(config.endoscope)),
        consecutive=list(range(min(frames, scope.consecutive))),
        length=frames,
    )


def family_sources(scope: Scope, seed: int = TEST_SEED) -> list[Source]:
    """One source with a synthetic sequence per instrument absent from the training data."""
    frames, domains = scope.family_frames, _FAMILY_DOMAINS
    return [
        Source(
            f"{FAMILY} {robot}",
            f"seed {seed}: two arms, {counted(frames, 'frame')}, each in {counted(len(domains), 'domain')}",
            "left",
            list(range(frames)),
            *_made_once(
                _config(scope, seed, f"{robot} {seed}", frames, robot=Path(f"builtin:{robot}"), domains=domains)
            ),
            cameras=("left",),
            domains=domains,
            length=frames,
        )
        for robot in (HELD_OUT if frames else ())
    ]


def _config(scope: Scope, seed: int, name: str, frames: int, **settings: Any) -> SynthesisConfig:
    motion = MotionConfig(frames=frames, frame_rate=frames / _MOTION_SECONDS)
    return SynthesisConfig(seed=seed, name=name, motion=motion, render=RenderConfig(samples=scope.samples), **settings)


def _made_once(config: SynthesisConfig) -> tuple[str, Callable[[Progress], Sequence]]:
    """Fingerprint of a synthetic sequence, and a function that opens the sequence and, if missing, renders it into the
    cache."""
    fingerprint = hashlib.sha256(repr((config, code_fingerprint(_SYNTHESIS))).encode()).hexdigest()[:32]
    folder = output_path(cache_dir(), "benchmark", f"sequence_{config.seed}_{fingerprint[:8]}")

    def open_(progress: Progress) -> Sequence:
        file = folder / "sequence.toml"
        if not holds_file(file):
            synthesize(config, folder, progress)
        return Sequence.open(file.path)

    return fingerprint, open_


def _masked(sequence: Sequence, camera: str) -> list[int]:
    """Indices of the frames with a mask."""
    return [index for index in range(len(sequence)) if camera in (sequence.frame(index).masks or {})]


def _digest(*parts: object) -> "hashlib._Hash":
    return hashlib.sha256(repr(parts).encode())


def _add_frames(digest: "hashlib._Hash", sequence: Sequence, indices: Iterable[int], cameras: Items[str] | None) -> str:
    """Add images and measured joint positions to a hash; returns the fingerprint."""
    for index in sorted(set(indices)):
        frame = sequence.frame(index, cameras=cameras)
        for values in (*frame.images.values(), *frame.measured.values()):
            digest.update(values.tobytes())
    return digest.hexdigest()[:32]


def real_source(path: Path, scope: Scope, seed: int = TEST_SEED) -> Source:
    """Source with the frames of a real sequence that have a mask in the first camera.

    Raises:
        SequenceError: the sequence is not usable.
        SettingsError: no frame has a mask.
    """
    sequence = Sequence.open(path)
    camera = sequence.scene.cameras[0]
    masked = _masked(sequence, camera.name)
    if not masked:
        raise SettingsError(
            f"{path} has no masks for camera {camera.name!r}, so results cannot be scored. Give `masks`."
        )
    frames = [masked[place] for place in evenly_spaced(len(masked), scope.frames)]
    consecutive = masked[: scope.consecutive]
    hashed = *frames, *consecutive, *evenly_spaced(len(sequence), scope.calibration_frames)
    code = code_fingerprint((*_SYNTHESIS, *_ALTERING_CODE))

    def open_(progress: Progress) -> Counterfactual:
        progress("rendering the backdrop of the real frames", 0, 1)
        return Counterfactual(sequence, camera.name, backdrop(camera.width, camera.height, seed), seed)

    taken = f"all methods evaluated on {len(frames)} of {counted(len(masked), 'frame')} with masks"
    return Source(
        REAL,
        f"{sequence.name}, camera {camera.name}, {taken}",
        camera.name,
        frames,
        _add_frames(_digest(read_bytes(path, SEQUENCE), seed, code), sequence, hashed, None),
        open_,
        cameras=tuple(camera.name for camera in sequence.scene.cameras),
        consecutive=consecutive,
        length=len(sequence),
    )


def _rooms(folder: Path | None, scope: Scope, *parts: object) -> "tuple[list[Room], hashlib._Hash]":
    """Rooms, and a hash of the rooms and `parts`."""
    rooms = (synthetic_rooms() + (photographs(folder) if folder else []))[:: scope.room_share]
    digest = _digest(*parts, code_fingerprint(_ROOMS_CODE))
    for photograph in sorted(folder.glob("*")) if folder else []:
        digest.update(photograph.name.encode() + read_bytes(photograph, IMAGE))
    return rooms, digest


def synthetic_room_source(sequence: Source, folder: Path | None, scope: Scope, seed: int = TEST_SEED) -> Source:
    """Source with the instruments of the synthetic sequence in other rooms; arguments as for `room_sources`."""
    rooms, digest = _rooms(folder, scope, sequence.fingerprint, seed)
    frames = [sequence.frames[place] for place in evenly_spaced(len(sequence.frames), scope.room_frames)]

    def open_(progress: Progress) -> AnotherRoom:
        recording = sequence.open(progress)
        assert isinstance(recording, Sequence)
        return AnotherRoom(recording, rooms, seed)

    return Source(
        f"{ROOMS} {SYNTHETIC}",
        f"{counted(len(frames), 'frame')} in {counted(len(rooms), 'room')}",
        sequence.camera,
        frames,
        digest.hexdigest()[:32],
        open_,
        consecutive=[sequence.consecutive[i] for i in evenly_spaced(len(sequence.consecutive), scope.room_consecutive)],
        rooms=[room.domain for room in rooms],
    )


def room_sources(path: Path, folder: Path | None, scope: Scope, seed: int = TEST_SEED) -> list[Source]:
    """Sources with the instruments of a real sequence composited over other backgrounds, one for each camera with
    masks.

    Photographs in `folder` are used in addition to synthetic backgrounds; `seed` sets lighting and noise.

    Raises:
        SequenceError: the sequence is not usable.
        SettingsError: the folder contains no photograph.
    """
    sequence = Sequence.open(path)
    rooms, digest = _rooms(folder, scope, read_bytes(path, SEQUENCE), seed)
    sources = []
    for camera in (known.name for known in sequence.scene.cameras):
        if not (masked := _masked(sequence, camera)):
            continue
        frames = [masked[place] for place in evenly_spaced(len(masked), scope.room_frames + 2)[1:-1]]
        together = [masked[place] for place in evenly_spaced(len(masked), scope.room_consecutive)]
        sources.append(
            Source(
                f"{ROOMS} {camera}",
                f"{sequence.name}, camera {camera}, {counted(len(frames), 'frame')} in {counted(len(rooms), 'room')}",
                camera,
                frames,
                _add_frames(digest, sequence, (*frames, *together), [camera]),
                lambda _: AnotherRoom(sequence, rooms, seed),
                consecutive=together,
                rooms=[room.domain for room in rooms],
            )
        )
    return sources
