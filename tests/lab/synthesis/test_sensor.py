"""The image sensor."""

import numpy as np
import pytest

from carts_core.lab.synthesis import SensorConfig
from carts_core.lab.synthesis.domains import expose, exposure_gain

IDEAL = SensorConfig(vignette=0.0, blur=0.0, full_well=1e6, read_noise=0.0, sharpening=0.0)


def _grey(level: float, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    return np.full((*shape, 3), level, np.float32)


def _expose(light: np.ndarray, config: SensorConfig, **options) -> np.ndarray:
    return expose(light, config, np.random.default_rng(0), **options).astype(float)


def test_the_gain_puts_the_median_where_it_was_asked_for() -> None:
    radiance = np.random.default_rng(0).uniform(0.0, 7.0, (20, 20, 3))
    gain = exposure_gain(radiance, SensorConfig(exposure=0.2))
    assert np.median(gain * radiance) == pytest.approx(0.2)


@pytest.mark.parametrize(("light", "value"), [(0.0, 0), (0.214, 127), (0.05, 63)])
def test_an_ideal_sensor_follows_the_srgb_curve(light: float, value: int) -> None:
    assert _expose(_grey(light), IDEAL).mean() == pytest.approx(value, abs=1.0)


def test_highlights_roll_off_instead_of_clipping_hard() -> None:
    levels = [_expose(_grey(light), IDEAL).mean() for light in (0.6, 0.8, 1.0, 1.5, 10.0)]
    assert np.all(np.diff(levels) > 0)
    assert levels[2] < 250 < levels[4]


def test_the_vignette_darkens_the_corners_only() -> None:
    picture = _expose(_grey(0.3), SensorConfig(vignette=0.5, blur=0.0, full_well=1e6, read_noise=0.0))
    assert picture[24, 32, 0] > 1.2 * picture[0, 0, 0]
    assert picture[24, 32, 0] == pytest.approx(_expose(_grey(0.3), IDEAL)[24, 32, 0], abs=1.0)


def test_in_the_dark_noise_takes_a_larger_share() -> None:
    shares = []
    for light in (0.4, 0.4 * 0.22):
        picture = _expose(_grey(light, (120, 160)), SensorConfig(vignette=0.0))
        shares.append(picture.std() / picture.mean())
    assert shares[1] > 1.5 * shares[0]


def test_the_lens_blurs_an_edge_and_motion_blurs_it_along_its_way() -> None:
    edge = _grey(0.1)
    edge[:, 32:] = 0.5

    def width(picture: np.ndarray) -> int:
        profile = picture[24, :, 0]
        return int(((profile > profile.min() + 5) & (profile < profile.max() - 5)).sum())

    sharp = width(_expose(edge, IDEAL))
    lens = width(_expose(edge, SensorConfig(vignette=0.0, blur=10.0, full_well=1e6, read_noise=0.0, sharpening=0.0)))
    motion = np.zeros((48, 64, 2), np.float32)
    motion[..., 0] = 6.0
    along = width(_expose(edge, IDEAL, motion=motion))
    across = width(_expose(edge, IDEAL, motion=motion[..., ::-1].copy()))
    assert sharp <= 2 < lens
    assert across <= 2 < along


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert np.array_equal(_expose(_grey(0.2), SensorConfig()), _expose(_grey(0.2), SensorConfig()))
