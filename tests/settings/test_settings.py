"""Ranges of settings."""

from dataclasses import replace
from pathlib import Path

import pytest

from carts_core.cli.options import CalibrationOptions, SolverOptions
from carts_core.errors import SettingsError
from carts_core.settings import (
    DescentSolver,
    DomainConfig,
    EndoscopeConfig,
    MotionConfig,
    SensorConfig,
    SequenceSettings,
    SolverName,
    SurfaceSolver,
    SynthesisConfig,
    solver,
)
from carts_core.settings.stages import COLD, FirstOrder, Observe, reduced


@pytest.mark.parametrize("name", list(SolverName))
def test_what_print_settings_writes_gives_the_same_solver_back(name: SolverName, tmp_path: Path) -> None:
    options = SolverOptions(solver=name)
    path = tmp_path / "settings.toml"
    path.write_text(options.printed(), encoding="utf-8")
    again = SolverOptions(solver=name, settings=(str(path),))
    assert again.chosen == options.chosen and again.sequence == options.sequence


def test_a_settings_file_changes_only_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[solver]\nprior_deg = 4\n[sequence]\ninitial_frames = 2\n", encoding="utf-8")
    options = SolverOptions(settings=(str(path),))
    assert options.chosen == replace(SurfaceSolver(), prior_deg=4.0)
    assert options.sequence == SequenceSettings(initial_frames=2)


def test_single_settings_need_no_file() -> None:
    options = SolverOptions(settings=("iterations=7", "prior_deg = 4", "sequence.direction=backward"))
    assert options.chosen == SurfaceSolver(iterations=7, prior_deg=4.0)
    assert options.sequence.direction == "backward"
    with pytest.raises(SettingsError, match="iterations is 0; allowed: 1 to 10000"):
        SolverOptions(settings=("iterations=0",))


def test_a_single_setting_may_be_longer_than_a_file_name(tmp_path: Path) -> None:
    text = "stages = [" + 10 * "{ stage = 'Descend', blur = 2.0 }, " + "]"
    assert len(text) > 300
    path = tmp_path / "settings.toml"
    path.write_text(f"[solver]\n{text}\n", encoding="utf-8")
    assert SolverOptions(settings=(text,)).chosen == SolverOptions(settings=(str(path),)).chosen != SurfaceSolver()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[solver]\npriors = 1", r"\[solver\] has no setting 'priors'\. .*Settings: .*prior_deg"),
        ("[solver]\nprior_deg = 'wide'", r"\[solver\]\.prior_deg is 'wide'; give a value such as 2\.5"),
        ("[solver]\nprior_deg = 1e9", "prior_deg is .*; allowed: 0.001 to 360 deg"),
        ("[solver]\nprior_deg = nan", "prior_deg is nan; allowed:"),
        ("[[solver.stages]]\nstage = 'SilhouetteSearch'\nenough = -1.0", "enough is -1.0; allowed: 0 to 1000 px"),
        ("[[solver.stages]]\nstage = 'RandomRestart'\nscale = 0.0\nthen = []", "scale is 0.0; allowed: 0.1 to 8"),
        ("[[solver.stages]]\nstage = 'Dance'", "has the stage 'Dance'; allowed: Observe, Descend"),
        ("[[solver.stages]]\nstage = []", r"has the stage \[\]; allowed: Observe, Descend"),
        ("[[solver.stages]]\nstage = 'Descend'", "requires a blur"),
        ("[[solver.stages]]\nstage = 'Descend'\nblur = 2.0\nspeed = 1", "has no setting 'speed'.*Settings: blur"),
        ("[solver]\nstages = 3", "must be a list of tables"),
        ("[slover]\nprior_deg = 1", "contains slover; allowed: tables"),
        ("prior_deg = 1", "contains prior_deg; allowed: tables"),
        ("[solver", "is not TOML"),
    ],
)
def test_a_wrong_settings_file_is_told_in_words(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=message):
        SolverOptions(settings=(str(path),))


def test_settings_that_a_calibration_does_not_use_are_refused() -> None:
    for text in ('free.locked_cameras=["left"]', "sequence.initial_frames=3"):
        with pytest.raises(SettingsError, match=r"allowed: tables \[solver\]\."):
            CalibrationOptions(settings=(text,))


def test_a_solver_of_another_name_is_refused() -> None:
    with pytest.raises(SettingsError, match="solver is 'magic'; allowed: surface"):
        solver("magic")


def test_stages_of_another_solver_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"stages is .*; allowed: stages of the surface solver"):
        SurfaceSolver(stages=(FirstOrder(),))
    with pytest.raises(SettingsError, match=r"stages is .*; allowed: one or more FirstOrder"):
        DescentSolver(stages=(Observe(),))


@pytest.mark.parametrize(
    ("name", "value"),
    [("iterations", 0), ("learning_rate", -1.0), ("method", "magic"), ("loss", "l7"), ("length_scale", 0.0)],
)
def test_a_setting_out_of_range_says_what_is_allowed(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"{name} is .*; allowed: "):
        DescentSolver(**{name: value})  # pyright: ignore[reportArgumentType]


def test_a_smaller_preset_observes_smaller_images_and_changes_nothing_else() -> None:
    small = reduced(COLD, 1.0)
    assert max(stage.scale for stage in small if isinstance(stage, Observe)) == 1.0
    assert [type(stage) for stage in small] == [type(stage) for stage in COLD]


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: EndoscopeConfig(distance=20.0), "EndoscopeConfig.distance is 20.0; allowed: 0.05 to 10"),
        (lambda: MotionConfig(frames=0), "MotionConfig.frames is 0"),
        (lambda: SensorConfig(jpeg_quality=101), "jpeg_quality is 101; allowed: 1 to 100"),
        (lambda: DomainConfig(blood_coverage=1.5), "DomainConfig.blood_coverage is 1.5"),
        (lambda: SynthesisConfig(domains=("fog",)), "give at least one of: regular, low_brightness"),
        (lambda: SynthesisConfig(domains=()), "give at least one of"),
        (lambda: SynthesisConfig(seed=-1), "SynthesisConfig.seed is -1"),
        (lambda: MotionConfig(jaw_range=(0.5, 0.1)), "MotionConfig.jaw_range"),
        (lambda: MotionConfig(reach=(0.01, -0.01, 0.0)), "MotionConfig.reach"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(make, text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        make()
