"""Sensor, smoke and blood of synthetic images."""

import numpy as np
import pytest

from carts_core.lab.synthesis import DomainConfig, SensorConfig
from carts_core.lab.synthesis.domains import Bleeding, Smoke, expose
from carts_core.lab.synthesis.path_tracer import Surface
from carts_core.lab.synthesis.scene import Tissue, grow_tissue

HEIGHT, WIDTH = 60, 80
IDEAL = SensorConfig(vignette=0.0, blur=0.0, full_well=1e6, read_noise=0.0, sharpening=0.0)
CAMERA_POSITION = np.array([0.0, 0.0, 0.1])
LIGHT = np.full((HEIGHT, WIDTH, 3), 0.3, np.float32)


@pytest.fixture(scope="module")
def tissue() -> Tissue:
    return grow_tissue("muscle", 64, 256, np.random.default_rng(0))


@pytest.mark.parametrize(("light", "value"), [(0.0, 0), (0.214, 127), (0.05, 63)])
def test_an_ideal_sensor_follows_the_srgb_curve(light: float, value: int) -> None:
    picture = expose(np.full((8, 8, 3), light, np.float32), IDEAL, np.random.default_rng(0))
    assert picture.mean() == pytest.approx(value, abs=1.0)


def test_motion_blurs_an_edge_along_its_way_only() -> None:
    edge = np.full((HEIGHT, WIDTH, 3), 0.1, np.float32)
    edge[:, WIDTH // 2 :] = 0.5
    motion = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    motion[..., 0] = 6.0

    def width(motion: np.ndarray) -> int:
        row = expose(edge, IDEAL, np.random.default_rng(0), motion=motion)[HEIGHT // 2, :, 0].astype(int)
        return int(((row > row.min() + 5) & (row < row.max() - 5)).sum())

    assert width(motion[..., ::-1].copy()) <= 2 < width(motion)


def test_what_is_farther_away_loses_more_contrast_in_smoke() -> None:
    rows, columns = np.indices((HEIGHT, WIDTH))
    rays = np.stack([(columns - WIDTH / 2) / 70, (rows - HEIGHT / 2) / 70, np.ones((HEIGHT, WIDTH))], axis=-1)
    board = (rows + columns) % 2
    light = np.repeat(0.1 + 0.4 * board[..., None], 3, axis=-1).astype(np.float32)
    smoke, contrast = Smoke(DomainConfig(), np.random.default_rng(2)), []
    for depth in (0.04, 0.09, 0.14):
        seen = smoke.haze(light, depth * rays, np.zeros(3), 10.0, 0.0)[..., 0]
        contrast.append((seen[board == 1].mean() - seen[board == 0].mean()) / seen.mean())
    assert contrast[0] > 1.2 * contrast[1] > 1.2 * 1.1 * contrast[2]


def looking_down(link: int, shift: float = 0.0) -> Surface:
    """A level surface seen from above: tissue, or of a link that has moved along x."""
    y, x = np.meshgrid(np.linspace(-0.045, 0.045, HEIGHT), np.linspace(-0.06, 0.06, WIDTH), indexing="ij")
    position = np.stack([x + shift, y, np.zeros_like(x)], axis=-1)
    normal = np.broadcast_to(np.array([0.0, 0.6, 0.8]), position.shape)
    return Surface(position, normal, np.full((HEIGHT, WIDTH), link), np.full((HEIGHT, WIDTH), 0.1))


def test_blood_is_dark_and_red_and_covers_about_what_was_asked_for(tissue: Tissue) -> None:
    bleeding = Bleeding(tissue, DomainConfig(blood_coverage=0.4), np.random.default_rng(1))
    stained = bleeding.stain(LIGHT, looking_down(-1), {0: np.eye(4)}, CAMERA_POSITION, 1.0)
    bloody = stained[..., 1] < 0.3 * LIGHT[..., 1]
    assert 0.15 < bloody.mean() < 0.65
    assert (stained[bloody][:, 0] > 2.0 * stained[bloody][:, 1]).mean() > 0.95


def test_blood_moves_with_the_instrument(tissue: Tissue) -> None:
    bleeding, T_world_link = Bleeding(tissue, DomainConfig(), np.random.default_rng(1)), np.eye(4)
    T_world_link[0, 3] = 0.02
    before = bleeding.stain(LIGHT, looking_down(0), {0: np.eye(4)}, CAMERA_POSITION, 0.0)
    after = bleeding.stain(LIGHT, looking_down(0, shift=0.02), {0: T_world_link}, CAMERA_POSITION, 0.0)
    np.testing.assert_allclose(before, after, atol=1e-5)
