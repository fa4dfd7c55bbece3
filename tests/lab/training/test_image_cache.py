from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from lab_robots import write_urdf

from carts_core.errors import SettingsError, WeightsError
from carts_core.lab.randomization import SurfaceGenerator, SurfaceSample
from carts_core.lab.training import cache
from carts_core.lab.training.augmentation import augmented, pasted, randomized, shaded, shadowed, warped_map
from carts_core.lab.training.cache import ImageCache, make_cache
from carts_core.lab.training.loader import training_batches
from carts_core.lab.training.training import train
from carts_core.model.robot import Robot
from carts_core.networks.weights import read_weights
from carts_core.settings import ImageSettings, SurfaceArchitecture, TrainingConfig

SMALL = SurfaceArchitecture(decoder=(4, 4, 4, 4), conditioning=(4, 4))


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "SHARD", 4)
    monkeypatch.setattr(cache, "SCENES", 3)


def config(folder: Path, **changes) -> TrainingConfig:
    images = ImageSettings(width=64, height=48, field_width=80, things=0.0, absent=0.0)
    values: dict[str, Any] = {"network": "surface", "images": images, "surface_architecture": SMALL, "cache": folder}
    values |= {"batch_size": 4, "steps": 12, "warmup": 2, "workers": 0, "threads": 1, "validation_samples": 2}
    return TrainingConfig(**{**values, "cached": 8, **changes})


def test_a_cache_holds_what_the_generator_makes_and_is_made_once(tmp_path: Path, shipped_psm: Robot):
    settings, progress = config(tmp_path), []
    make_cache(tmp_path, settings, lambda done, total: progress.append((done, total)))
    assert progress == [(0, 8), (4, 8), (8, 8)]
    kept = ImageCache(tmp_path, 2)
    assert len(kept) == 8
    generator = SurfaceGenerator([shipped_psm], settings.images, (settings.seed, 2, 1))
    for number in (5, 4):
        samples = generator.samples(number - 4, cache.PRIORS)
        for prior, sample in enumerate(samples):
            for stored, made in zip(
                kept.sample(number, prior), (sample.observed, sample.surface, sample.given), strict=True
            ):
                np.testing.assert_array_equal(stored, made)
    assert kept.scenes == 6
    np.testing.assert_array_equal(kept.scene(5), generator.scene(2))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    (tmp_path / "samples-00001.safetensors").unlink()
    make_cache(tmp_path, settings)
    after = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert after.keys() == before.keys() and sum(after[path] != before[path] for path in after) == 1


def test_a_damaged_shard_is_named_with_the_remedy(tmp_path: Path):
    (tmp_path / "samples-00000.safetensors").write_bytes(b"half a file")
    with pytest.raises(WeightsError, match=r"samples-00000.* cannot be read .*Delete the file"):
        ImageCache(tmp_path, 1)


def test_a_cache_of_other_settings_is_refused(tmp_path: Path):
    settings = config(tmp_path)
    make_cache(tmp_path, settings)
    make_cache(tmp_path, replace(settings, steps=13, seed=1))
    with pytest.raises(SettingsError, match=r"samples-00000.* other robots or image settings. Give another cache"):
        make_cache(tmp_path, replace(settings, images=replace(settings.images, blood=0.5)))


def test_a_cache_of_another_robot_of_the_same_name_is_refused(tmp_path: Path):
    for limit, name in enumerate("ab", start=1):
        (tmp_path / name).mkdir()
        write_urdf(tmp_path / name / "robot.urdf", {"joint": (-1.0, limit)})
    settings = config(tmp_path, cached=4, robots=(tmp_path / "a" / "robot.urdf",))
    make_cache(tmp_path, settings)
    (tmp_path / "a").rename(tmp_path / "moved")
    make_cache(tmp_path, replace(settings, robots=(tmp_path / "moved" / "robot.urdf",)))
    with pytest.raises(SettingsError, match=r"samples-00000.* other robots or image settings"):
        make_cache(tmp_path, replace(settings, robots=(tmp_path / "b" / "robot.urdf",)))


def test_a_surface_network_learns_from_a_cache_and_goes_on_with_the_same_batches(tmp_path: Path):
    settings = config(tmp_path / "images")
    losses: list[float] = []
    train(settings, tmp_path / "run", lambda event: losses.append(event.loss))
    assert losses[-1] < losses[0]
    with training_batches(settings, 0) as first, training_batches(settings, 3) as later:
        for _ in range(3):
            next(first)
        for one, same in zip(next(first), next(later), strict=True):
            assert one.shape[0] == 4 and one.equal(same)


def test_frozen_stages_keep_their_weights(tmp_path: Path):
    settings = config(tmp_path / "images", cached=4, batch_size=2, warmup=1)
    trained = {}
    for steps in (1, 3):
        result = train(replace(settings, steps=steps, frozen=2), tmp_path / f"run{steps}")
        trained[steps] = read_weights(result.weights).network.state_dict()
    for name, values in trained[1].items():
        if name.startswith(("encoder.stem", "encoder.stages.0", "encoder.stages.1")):
            assert values.equal(trained[3][name])
        elif name.startswith("encoder"):
            assert not values.equal(trained[3][name])


def test_a_cache_is_refused_for_the_feature_network(tmp_path: Path):
    with pytest.raises(SettingsError, match="only supported for the surface network"):
        config(tmp_path, network="feature")


def test_other_colours_leave_shapes_alone():
    image = np.zeros((40, 60, 3), np.uint8)
    image[10:30, 20:40] = 200, 120, 60
    for seed in range(5):
        changed = augmented(np.random.default_rng(seed), image).astype(int).sum(2)
        outside = np.ones(changed.shape, bool)
        outside[10:30, 20:40] = False
        assert changed[10:30, 20:40].min() > changed[outside].max()


def test_a_rotated_map_is_the_map_of_the_rotated_arm():
    """A quarter turn moves a part from the right to the top, and its normal with it."""
    surface = np.zeros((48, 48, 6), np.int8)
    surface[20:28, 30:40, 2], surface[20:28, 30:40, 3:] = 127, (100, 0, -60)
    turned = warped_map(surface, cv2.getRotationMatrix2D((23.5, 23.5), 90, 1), (48, 48))
    expected = np.zeros_like(surface)
    expected[8:18, 20:28, 2], expected[8:18, 20:28, 3:] = 127, (0, -100, -60)
    np.testing.assert_array_equal(turned, expected)


def test_pasted_arms_hide_those_behind():
    def arm(color: int, rows: slice, part: int) -> SurfaceSample:
        surface = np.zeros((8, 8, 6), np.int8)
        surface[rows, :, part] = 127
        return SurfaceSample(np.full((8, 8, 3), color, np.uint8), surface, surface)

    both = pasted(arm(200, slice(0, 4), 0), arm(50, slice(2, 6), 1))
    assert (both.observed[:4] == 200).all() and (both.observed[4:] == 50).all()
    for surface in (both.given, both.surface):
        assert (surface[:4, :, 0] == 127).all() and (surface[:4, :, 1] == 0).all() and (surface[4:6, :, 1] == 127).all()
        assert not surface[6:].any()


def test_pasted_arms_sometimes_cast_a_grey_shadow_near_them():
    surface = np.zeros((160, 80, 6), np.int8)
    surface[60:80, :, 0] = 127
    nothing = np.zeros_like(surface)
    scene = SurfaceSample(np.full((160, 80, 3), 200, np.uint8), nothing, nothing)
    dark = []
    for seed in range(40):
        image = shadowed(np.random.default_rng(seed), scene, surface).observed
        if image.min() < 190:
            dark.append(image)
            assert image.min() >= 200 * 0.02 - 1 and (image[..., :1] == image).all()
            assert abs(int((200 - image[:, 40, 0].astype(float)).argmax()) - 70) < 50
    assert 8 < len(dark) < 32


def test_a_further_shadow_of_arms_falls_beside_them_only():
    surface = np.zeros((160, 80, 6), np.int8)
    surface[60:80, :, 0] = 127
    sample = SurfaceSample(np.full((160, 80, 3), 200, np.uint8), surface, surface)
    images = [shaded(np.random.default_rng(seed), sample).observed for seed in range(40)]
    assert all((image[60:80] == 200).all() for image in images)
    assert 8 < sum(image.min() < 190 for image in images) < 36


def test_crops_are_mostly_around_arms(tmp_path: Path):
    make_cache(tmp_path, config(tmp_path))
    kept, rng = ImageCache(tmp_path, 2), np.random.default_rng(0)
    samples = [randomized(rng, kept, number % len(kept), (32, 16)) for number in range(60)]
    assert all(sample.observed.shape == (16, 32, 3) for sample in samples)
    assert all(sample.given.shape == sample.surface.shape == (16, 32, 6) for sample in samples)
    assert np.mean([sample.surface[..., :3].any() for sample in samples]) > 0.5
    assert 0 < np.mean([not sample.given.any() for sample in samples]) < 0.5


def test_a_crop_larger_than_the_images_is_refused(tmp_path: Path):
    with pytest.raises(SettingsError, match=r"crop is \(96, 48\); give multiples of 16 up to 64 and 48"):
        config(tmp_path, crop=(96, 48))
    with pytest.raises(SettingsError, match="crop requires cached images; give `cache`"):
        config(tmp_path, cache=None, crop=(32, 16))


def test_an_image_is_not_darkened():
    image = np.full((40, 60, 3), 100, np.uint8)
    means = [augmented(np.random.default_rng(seed), image).mean() for seed in range(200)]
    assert np.mean(means) > 100 and np.quantile(means, 0.01) > 88  # A tint changes the mean by a few per cent.
