"""Settings of a synthetic sequence."""

import pytest

from carts_core.errors import SettingsError
from carts_core.settings import DomainConfig, EndoscopeConfig, MotionConfig, SensorConfig, SynthesisConfig


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: EndoscopeConfig(distance=20.0), "EndoscopeConfig.distance is 20.0; it must lie between 0.05 and 10"),
        (lambda: MotionConfig(frames=0), "MotionConfig.frames is 0"),
        (lambda: SensorConfig(jpeg_quality=101), "between 1 and 100"),
        (lambda: DomainConfig(blood_coverage=1.5), "DomainConfig.blood_coverage is 1.5"),
        (lambda: SynthesisConfig(domains=("fog",)), "name at least one of: regular, low_brightness"),
        (lambda: SynthesisConfig(domains=()), "name at least one of"),
        (lambda: SynthesisConfig(seed=-1), "SynthesisConfig.seed is -1"),
        (lambda: MotionConfig(jaw_range=(0.5, 0.1)), "MotionConfig.jaw_range"),
        (lambda: MotionConfig(reach=(0.01, -0.01, 0.0)), "MotionConfig.reach"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(make, text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        make()


def test_each_purpose_has_random_numbers_of_its_own() -> None:
    config = SynthesisConfig(seed=1)
    draws = {config.rng(*purpose).integers(2**60) for purpose in (("motion",), ("motion", 1), ("tissue", 1))}
    assert len(draws) == 3
    assert config.rng("motion").integers(2**60) in draws
