"""Shared fixtures: reference data, if available, and small generated sequences."""

import csv
import signal
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny import TinyImage, TinyScene, tiny_images, tiny_scene
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

from carts_core.model.robot import Robot
from carts_core.networks import FeatureExtractor
from carts_core.process import tune_process
from carts_core.resources import sample_sequence, shipped_robot

pytest_plugins = ["small_network"]

ROOT = Path(__file__).resolve().parents[1]

# A shell that runs the tests in the background or under nohup has them ignore these, and so do the commands they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


class _BrowserTestsInOneProcess(LoadFileScheduling):
    """Tests of a file run in one process, and all browser tests in the same one: browsers that draw at the same time
    slow each other down."""

    def _split_scope(self, nodeid: str) -> str:
        scope = super()._split_scope(nodeid)
        return "browser" if _has_browser_tests(self.config.rootpath / scope) else scope


@cache
def _has_browser_tests(file: Path) -> bool:
    return "mark.browser" in file.read_text()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadFileScheduling | None:
    """Use the scheduler above with `--dist loadfile`."""
    return _BrowserTestsInOneProcess(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start the files of browser tests first: they take longest, and a file is run by one process."""
    long = {item.path for item in items if item.get_closest_marker("browser")}
    items.sort(key=lambda item: item.path not in long)


@pytest.fixture(scope="session", autouse=True)
def _nothing_in_the_home_folder(
    pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """Cache of decimated meshes, kept between test runs, and user data outside of the home folder."""
    assert pytestconfig.cache is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARTS_CACHE", str(pytestconfig.cache.mkdir("meshes")))
        patch.setenv("CARTS_DATA", str(tmp_path_factory.mktemp("session data")))
        yield


@pytest.fixture(autouse=True)
def _data_of_the_user(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CARTS_DATA", str(tmp_path_factory.mktemp("data")))


@pytest.fixture(scope="session", autouse=True)
def _tuned_as_the_command() -> None:
    tune_process()


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    """Restore the number of threads after tests that train or compare numbers of threads."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


_LOADED: dict[tuple[object, ...], FeatureExtractor] = {}


@pytest.fixture(scope="module", autouse=True)
def _networks_loaded_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Load networks from the same files once, except in tests of the networks."""
    if request.path.parent.name == "networks":
        yield
        return
    load = FeatureExtractor.load

    def load_once(*weights: Path | str, **options) -> FeatureExtractor:
        files = [Path(path) for path in weights]
        if not all(path.is_file() for path in files):
            return load(*weights, **options)
        key = (*((path, path.stat().st_mtime_ns) for path in files), *sorted(options.items()))
        if key not in _LOADED:
            _LOADED[key] = load(*weights, **options)
        return _LOADED[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FeatureExtractor, "load", load_once)
        yield


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Reference data and third-party robots beside the checkout; tests that need them are skipped without them."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("the reference data are not beside this checkout")
    return path


@pytest.fixture(scope="session")
def sample_sequence_path() -> Path:
    """The shipped sequence file."""
    return sample_sequence()


@pytest.fixture(scope="session")
def shipped_psm() -> Robot:
    """The shipped PSM with a Large Needle Driver."""
    return Robot.load(shipped_robot())


def _write_table(path: Path, robot: Robot, positions: np.ndarray) -> None:
    with path.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["frame", "time", *robot.joint_names])
        for row, values in enumerate(positions):
            writer.writerow([row + 1, f"{row / 10:.3f}", *(f"{value:.9f}" for value in values)])


def _write_images(folder: Path, images: tuple[TinyImage, ...], domains: tuple[str, ...]) -> None:
    for entry in images:
        name = f"{entry.camera}/{entry.row + 1:03d}.png"
        for kind in ("masks", *domains):
            (folder / kind / entry.camera).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "masks" / name), entry.mask.astype(np.uint8) * 255)
        for number, domain in enumerate(domains):
            pixels = np.rint(255 * entry.image / (1 + number)).astype(np.uint8)
            cv2.imwrite(str(folder / domain / name), pixels[..., ::-1])


def _sequence_toml(tiny: TinyScene, domains: tuple[str, ...], robot: str, masks: bool, truth: bool) -> str:
    joints = "\n".join(f'{name} = "{name}"' for name in tiny.scene.arms[0].robot.joint_names)
    lines = [
        'format = "carts-sequence/1"',
        'name = "tiny"',
        f"domains = {list(domains)}",
        "[kinematics]",
        'table = "kinematics.csv"',
        'frame_id = "{frame:03d}"',
        'timestamp = "time"',
        'truth = "truth.csv"' if truth else "",
        "[[arms]]",
        'name = "PSM1"',
        f'robot = "{robot}"',
        "[arms.joints]",
        joints,
    ]
    for camera in tiny.scene.cameras:
        lines += [
            "[[cameras]]",
            f'name = "{camera.name}"',
            f"size = [{camera.width}, {camera.height}]",
            f"K = {camera.K.tolist()}",
            f"T_camera_world = {camera.T_camera_world.tolist()}",
            'images = "{domain}/{camera}/{frame}.png"',
            'masks = "masks/{camera}/{frame}.png"' if masks else "",
        ]
    return "\n".join(lines) + "\n"


def write_tiny_sequence(
    folder: Path,
    robot: Robot,
    *,
    frames: int = 3,
    domains: tuple[str, ...] = ("regular",),
    cameras: tuple[str, ...] = ("left",),
    width: int = 96,
    height: int = 72,
    masks: bool = True,
    truth: bool = True,
    edit: Callable[[str], str] = str,
) -> Path:
    """Write a small valid sequence of the shipped robot; returns its file.

    Each domain is darker than the previous one. `edit` converts the text of the sequence file before it is written.
    Files: `sequence.toml`, `kinematics.csv`, `truth.csv`, `DOMAIN/CAMERA/001.png`, `masks/CAMERA/001.png`.
    """
    tiny = tiny_scene(robot, frames, cameras, width, height)
    _write_table(folder / "kinematics.csv", robot, tiny.measured)
    _write_table(folder / "truth.csv", robot, tiny.truth)
    _write_images(folder, tiny_images(robot, frames, cameras, width, height), domains)
    path = folder / "sequence.toml"
    path.write_text(edit(_sequence_toml(tiny, domains, "builtin:psm_lnd", masks, truth)))
    return path


@pytest.fixture
def tiny_sequence(tmp_path: Path, shipped_psm: Robot) -> Callable[..., Path]:
    """Function that writes a tiny sequence into the test's folder, see `write_tiny_sequence`."""
    return partial(write_tiny_sequence, tmp_path, shipped_psm)


@pytest.fixture(scope="module")
def shared_sequence(tmp_path_factory: pytest.TempPathFactory, shipped_psm: Robot) -> Callable[..., Path]:
    """Function that writes a tiny sequence for all tests of a module, see `write_tiny_sequence`."""
    return lambda **options: write_tiny_sequence(tmp_path_factory.mktemp("tiny"), shipped_psm, **options)
