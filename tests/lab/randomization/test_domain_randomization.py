import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.files.reading import Kind, read_bytes
from carts_core.lab.randomization import (
    BACKGROUND,
    HEAD,
    SHAFT,
    AppearanceRanges,
    ImageSettings,
    PairGenerator,
    SurfaceGenerator,
    arms,
)
from carts_core.lab.randomization.arms import RobotGeometry, random_placement
from carts_core.lab.randomization.backgrounds import Photographs, random_background
from carts_core.lab.randomization.clutter import occlude
from carts_core.lab.randomization.shading import render_gbuffer
from carts_core.model.robot import Robot

SIZE = (192, 160)


@pytest.fixture(scope="module")
def geometry(shipped_psm: Robot) -> RobotGeometry:
    return RobotGeometry(shipped_psm)


def test_a_pair_is_two_images_that_are_not_low_light_and_their_classes(shipped_psm: Robot):
    generator = PairGenerator([shipped_psm], ImageSettings(), seed=5)
    pairs = [generator() for _ in range(4)]
    for pair in pairs:
        assert pair.observed.shape == pair.hybrid.shape == (160, 192, 3)
        assert pair.observed.dtype == pair.hybrid.dtype == np.uint8
        for classes in (pair.observed_classes, pair.hybrid_classes):
            assert classes.shape == (160, 192)
            assert set(np.unique(classes)) <= {BACKGROUND, SHAFT, HEAD}
    brightness = np.array([pair.observed.mean() / 255 for pair in pairs])
    assert brightness.min() > 0.08
    assert np.median(brightness) > 0.25


def test_the_same_seed_makes_the_same_pairs_and_another_seed_others(shipped_psm: Robot):
    first, again, other = (PairGenerator([shipped_psm], ImageSettings(), seed)() for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.observed, again.observed)
    np.testing.assert_array_equal(first.hybrid, again.hybrid)
    assert not np.array_equal(first.observed, other.observed)


def test_with_a_perfect_model_the_hybrid_shows_what_is_observed(shipped_psm: Robot, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(arms, "PERFECT_MODEL", 1.0)
    settings = ImageSettings(same_kinematics=1.0, same_background=1.0, two_arms=0.0, absent=0.0)
    pair = PairGenerator([shipped_psm], settings, seed=11)()
    overlap = (pair.observed_classes > 0) & (pair.hybrid_classes > 0)
    union = (pair.observed_classes > 0) | (pair.hybrid_classes > 0)
    # The observed image is antialiased and the hybrid one is not, so borders may differ by a pixel.
    assert overlap.sum() > 0.93 * union.sum()


@pytest.mark.parametrize(
    ("settings", "arguments", "allowed"),
    [
        (AppearanceRanges, {"brightness": (0.3, 1.0)}, "must not be trained on"),
        (AppearanceRanges, {"noise": (0.1, 0.0)}, "noise"),
        (AppearanceRanges, {"blur": (-1, 1)}, "blur"),
        (AppearanceRanges, {"jpeg_quality": (50, 120)}, "jpeg_quality"),
        (ImageSettings, {"width": 100}, "must be positive multiples of 16"),
        (ImageSettings, {"two_arms": 1.5}, "two_arms is 1.5; allowed: 0 to 1"),
        (ImageSettings, {"things": -0.1}, "things is -0.1; allowed: 0 to 1"),
        (ImageSettings, {"absent": 2}, "absent is 2; allowed: 0 to 1"),
        (ImageSettings, {"coverage": (0.5, 0.1)}, "give two fractions"),
        (ImageSettings, {"field_width": 64}, "give at least the width"),
        (
            ImageSettings,
            {"chains": 0.1, "recording": Path("a.toml")},
            "no poses in the recording a.toml. Leave out `chains`",
        ),
        (ImageSettings, {"field_width": 5000}, "field_width is 5000; allowed: 16 to 4096 px"),
    ],
)
def test_settings_out_of_range_are_refused(settings: type, arguments: dict, allowed: str):
    with pytest.raises(SettingsError, match=re.escape(allowed)):
        settings(**arguments)


def test_backgrounds_are_bright_enough_and_differ():
    images = [random_background(np.random.default_rng(seed), *SIZE) for seed in range(20)]
    assert all(image.shape == (160, 192, 3) and image.min() >= 0 for image in images)
    assert min(float(image.mean()) for image in images) > 0.15
    assert np.std([image.mean((0, 1)) for image in images], axis=0).min() > 0.05


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """A folder with a green and, deeper, a nearly black photograph."""
    (tmp_path / "deeper").mkdir()
    for name, color in (("green.png", (30, 200, 40)), ("deeper/dark.jpg", (4, 4, 4))):
        cv2.imwrite(str(tmp_path / name), np.full((90, 120, 3), color, np.uint8))
    (tmp_path / "notes.txt").write_text("no photographs")
    return tmp_path


def test_photographs_are_found_in_subfolders_and_none_is_low_light(photographs: Path):
    source, rng = Photographs(photographs), np.random.default_rng(0)
    assert len(source) == 2
    images = [source(rng, *SIZE) for _ in range(20)]
    assert all(image.shape == (160, 192, 3) and 0 <= image.min() and image.max() <= 1 for image in images)
    assert min(float(image.mean()) for image in images) >= 0.24


def test_photographs_are_read_on_demand_and_some_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    content = cv2.imencode(".png", np.full((9, 12, 3), 90, np.uint8))[1].tobytes()
    for number in range(300):
        (tmp_path / f"{number}.png").write_bytes(content)
    read: list[Path] = []

    def counting(path: Path, kind: Kind) -> bytes:
        read.append(path)
        return read_bytes(path, kind)

    monkeypatch.setattr("carts_core.lab.randomization.backgrounds.read_bytes", counting)
    source = Photographs(tmp_path)
    assert len(source) == 300 and not read
    for _ in range(2):
        rng = np.random.default_rng(0)
        for _ in range(20):
            source(rng, 16, 12)
    assert 0 < len(read) == len(set(read)) <= 20


@pytest.mark.parametrize("content", [None, b"no image"])
def test_a_folder_without_readable_photographs_is_refused(tmp_path: Path, content: bytes | None):
    if content is not None:
        (tmp_path / "broken.jpg").write_bytes(content)
    with pytest.raises(SettingsError, match=r"(Give a folder with at least one image file|Replace or remove it)"):
        Photographs(tmp_path)


@pytest.mark.parametrize(
    "settings",
    [
        (ImageSettings(things=0.0), ImageSettings(things=1.0)),
        (ImageSettings(occluded=0.0), ImageSettings(occluded=1.0)),
    ],
)
def test_occluders_are_not_part_of_the_labels(shipped_psm: Robot, settings: tuple[ImageSettings, ImageSettings]):
    bare, full = (SurfaceGenerator([shipped_psm], images, 5)() for images in settings)
    assert (bare.observed != full.observed).any()
    assert np.array_equal(bare.surface, full.surface)


def test_arms_may_be_claimed_that_are_not_there(shipped_psm: Robot):
    settings = ImageSettings(absent=1.0, two_arms=0.0)
    generator = SurfaceGenerator([shipped_psm], settings, 5)
    samples = [generator() for _ in range(15)]
    assert all((sample.surface == 0).all() for sample in samples)
    claimed = [bool((sample.given > 0).any()) for sample in samples]
    assert 0.7 < np.mean(claimed) < 1


def test_the_gbuffer_holds_points_on_the_ray_and_normals_towards_the_camera(geometry: RobotGeometry):
    rng = np.random.default_rng(6)
    intrinsics = (200.0, 200.0, 96.0, 80.0)
    placement = random_placement(rng, geometry, intrinsics, *SIZE)
    Ts = placement.T_camera_base @ geometry.link_transforms(placement.joint_positions)
    view = render_gbuffer([geometry], [geometry.posed(Ts)], intrinsics, *SIZE)
    assert len(view.rows) > 50
    u = view.points[:, 0] / view.points[:, 2] * 200 + 96
    v = view.points[:, 1] / view.points[:, 2] * 200 + 80
    np.testing.assert_allclose(u, view.columns + 0.5, atol=1e-3)
    np.testing.assert_allclose(v, view.rows + 0.5, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(view.normals, axis=1), 1, atol=1e-3)
    assert ((view.normals * view.points).sum(1) <= 1e-6).all()
    # A point given in its link's frame and moved to the camera is the point that the pixel sees.
    T = Ts[geometry.part_link[view.part]]
    moved = np.einsum("nij,nj->ni", T[:, :3, :3], view.points_link) + T[:, :3, 3]
    assert np.percentile(np.linalg.norm(moved - view.points, axis=1), 99) < 2e-4


def test_no_occluder_is_red_as_blood_is():
    rng = np.random.default_rng(4)
    coverage = np.ones((64, 80), np.float32)
    for _ in range(15):
        image = occlude(rng, np.zeros((64, 80, 3), np.float32), coverage)
        assert image.max() > 0.1
        assert (image[..., 0] <= image[..., 1:].max(2) + 1e-6).all()
