import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import pytest
import torch

from carts_core.errors import SettingsError, WeightsError
from carts_core.lab.randomization import ImageSettings
from carts_core.lab.training.loader import training_batches
from carts_core.lab.training.loop import CHECKPOINT_FILE, load_checkpoint, schedule
from carts_core.lab.training.training import TrainingProgress, train
from carts_core.networks import FeatureExtractor
from carts_core.networks.network import FeatureNetwork
from carts_core.networks.weights import read_weights, save_weights
from carts_core.resources import shipped_robot
from carts_core.settings import Architecture, SurfaceArchitecture, TrainingConfig

SMALL = {
    "batch_size": 2,
    "learning_rate": 1e-2,
    "warmup": 5,
    "average": 0.8,
    "validation_every": 15,
    "validation_samples": 2,
    "checkpoint_every": 5,
    "workers": 0,
    "threads": 1,
}


def small_config(**changes) -> TrainingConfig:
    architecture = Architecture(widths=(4, 6, 8), encoder_convolutions=(1, 1, 1), decoder_convolutions=(1, 1))
    images = ImageSettings(width=64, height=48, field_width=80, things=0.0, absent=0.0)
    return TrainingConfig(**({**SMALL, "steps": 30, "architecture": architecture, "images": images} | changes))


def test_a_run_learns_and_leaves_weights_a_checkpoint_and_a_report(tmp_path: Path):
    events: list[TrainingProgress] = []
    result = train(small_config(), tmp_path, events.append)
    assert events[-1].step == events[-1].steps == 30
    assert events[-1].loss < events[0].loss
    assert events[-1].validation == result.validation
    extractor = FeatureExtractor.load(result.weights)
    assert extractor.working_size == (80, 60)
    assert extractor.weights["feature"].training["step"] == 30
    assert extractor.weights["feature"].training["config"]["robots"] == ["psm_lnd.urdf"]
    page = result.report.read_text()
    assert "| 30 |" in page
    for picture in ("curves.png", "predictions.jpg"):
        assert picture in page
        assert (result.report.parent / picture).stat().st_size > 5_000


_RUN = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_training import small_config
from carts_core.lab.training.training import train
from carts_core.stopping import stopped_by_signals
with stopped_by_signals():
    train(small_config(steps=100_000, workers=int(sys.argv[3])), Path(sys.argv[1]))
"""


@pytest.mark.parametrize(
    ("sent", "workers"), [(signal.SIGKILL, 0), pytest.param(signal.SIGTERM, 1, marks=pytest.mark.slow)]
)
def test_a_killed_run_resumes_from_its_last_checkpoint(tmp_path: Path, sent: signal.Signals, workers: int):
    arguments = [sys.executable, "-c", _RUN, str(tmp_path), str(Path(__file__).parent), str(workers)]
    process = subprocess.Popen(arguments, start_new_session=True)
    try:
        deadline = time.monotonic() + 240
        while not (tmp_path / CHECKPOINT_FILE).is_file():
            assert process.poll() is None and time.monotonic() < deadline, "no checkpoint was written"
            time.sleep(0.1)
        os.killpg(process.pid, sent)
        assert process.wait(120) != 0
    finally:
        process.kill()
        process.wait()
    before = load_checkpoint(tmp_path)
    assert before is not None and before.step >= 5
    steps = before.step + 3
    result = train(small_config(steps=steps), tmp_path)
    after = load_checkpoint(tmp_path)
    assert after is not None and after.step == steps
    logged = [entry["step"] for entry in after.history.losses]
    assert logged == sorted(set(logged)) and logged[-1] == steps
    # The optimizer's own step count proves that its moments were restored and not started anew.
    counts = {int(value) for name, value in after.tensors.items() if name.endswith("/step")}
    assert counts == {steps}
    assert read_weights(result.weights).training["step"] == steps


@pytest.mark.slow
def test_a_run_ends_in_time_with_its_learning_rate_down_and_is_not_gone_on_with(tmp_path: Path):
    events: list[TrainingProgress] = []
    config = small_config(steps=100_000, minutes=0.02, validation_every=1_000)
    result = train(config, tmp_path, events.append)
    steps = events[-1].step
    assert 1 < steps == events[-1].steps < 100_000
    # At the pace that it had, one more step would have been too late.
    assert result.seconds * (steps + 1) / steps >= 60 * 0.02
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None and checkpoint.step == events[-1].step
    assert checkpoint.history.losses[-1]["step"] == checkpoint.step
    assert f"{checkpoint.step} steps of 2 samples" in result.report.read_text()
    assert train(config, tmp_path).seconds == result.seconds


def test_going_on_with_other_settings_is_refused_by_name(tmp_path: Path):
    train(small_config(steps=1), tmp_path)
    with pytest.raises(SettingsError, match=r"learning_rate was 0\.01 and is 0\.5.*another output folder"):
        train(small_config(steps=10, learning_rate=0.5), tmp_path)


def test_another_robot_or_start_of_the_same_name_is_refused(tmp_path: Path, small_network: FeatureNetwork):
    for step, name in enumerate("ab"):
        folder = shutil.copytree(shipped_robot().parent, tmp_path / name)
        with (folder / "psm_lnd.urdf").open("a") as urdf:
            urdf.write(f"<!-- {name} -->")
        save_weights(small_network, folder / "start.safetensors", {"step": step}, (320, 240))

    def config(robot: str, start: str) -> TrainingConfig:
        robots = (tmp_path / robot / "psm_lnd.urdf",)
        return small_config(steps=1, robots=robots, start=tmp_path / start / "start.safetensors")

    train(config("a", "a"), tmp_path / "run")
    (tmp_path / "a").rename(tmp_path / "moved")
    train(config("moved", "moved"), tmp_path / "run")
    with pytest.raises(SettingsError, match=r"settings: robots_digest was .* and is .*\. Give the same settings"):
        train(config("b", "moved"), tmp_path / "run")
    with pytest.raises(SettingsError, match=r"settings: start_digest was \w+ and is \w+\. Give the same settings"):
        train(config("moved", "b"), tmp_path / "run")


def test_the_run_of_an_older_version_without_digests_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as older:
        older.setattr("carts_core.lab.training.training.run_digests", lambda _: {})
        train(small_config(steps=1), tmp_path)
    train(small_config(steps=2), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None and checkpoint.step == 2


@pytest.mark.slow
def test_fine_tuning_takes_the_architecture_of_the_weights(tmp_path: Path, small_weights: Path):
    config = small_config(start=small_weights, architecture=Architecture(), steps=1)
    train(config, tmp_path)
    result = train(config, tmp_path)  # the run is there already and must count as the same
    weights = read_weights(result.weights)
    assert weights.network.architecture == read_weights(small_weights).network.architecture != Architecture()
    assert weights.training["config"]["architecture"]["widths"] == list(weights.network.architecture.widths)


def test_weights_of_another_network_are_refused(tmp_path: Path, small_weights: Path):
    with pytest.raises(SettingsError, match="holds a feature network, but a surface network is to be trained"):
        train(small_config(network="surface", start=small_weights), tmp_path)


def test_settings_of_an_encoder_are_refused_without_one(tmp_path: Path):
    with pytest.raises(SettingsError, match=r"frozen is 2 and encoder_rate 0\.3, but the feature network has no"):
        train(small_config(frozen=2), tmp_path)


def test_a_broken_checkpoint_is_named_with_the_remedy(tmp_path: Path):
    (tmp_path / CHECKPOINT_FILE).write_bytes(b"half a file")
    with pytest.raises(WeightsError, match=r"checkpoint\.safetensors is not a readable checkpoint.*Delete the file"):
        train(small_config(), tmp_path)


@pytest.mark.parametrize(
    ("workers_before", "workers", "reuse"),
    [(0, 0, 3), *(pytest.param(*given, 3, marks=pytest.mark.slow) for given in ((0, 1), (2, 2)))],
)
def test_the_stream_of_batches_goes_on_where_a_run_was_stopped(workers_before: int, workers: int, reuse: int):
    # One worker process makes what none makes.
    before, after = (small_config(workers=count, reuse=reuse) for count in (workers_before, workers))
    with training_batches(before, first_step=0) as batches:
        whole = list(islice(batches, 7))
    with training_batches(after, first_step=4) as batches:
        later = list(islice(batches, 3))
    for worker in multiprocessing.active_children():
        worker.join(20.0)
    assert not multiprocessing.active_children()
    for left, right in zip(whole[4:], later, strict=True):
        images, classes = right
        assert images.shape == (2, 2, 3, 48, 64) and images.dtype == torch.uint8
        assert classes.shape == (2, 2, 48, 64)
        assert all(torch.equal(a, b) for a, b in zip(left, right, strict=True))


@pytest.mark.slow
def test_a_run_in_parts_ends_with_the_bytes_of_one_in_one_go(tmp_path: Path):
    whole = train(small_config(steps=12), tmp_path / "whole")
    config = small_config(steps=12)

    def stop(progress: TrainingProgress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts", stop)
    stopped = load_checkpoint(tmp_path / "parts")
    assert stopped is not None and stopped.step == 10
    parts = train(config, tmp_path / "parts")
    assert parts.weights.read_bytes() == whole.weights.read_bytes()


def test_the_learning_rate_rises_and_then_falls_to_a_hundredth():
    values = [schedule(step, warmup=10, steps=100) for step in range(101)]
    assert values[0] == pytest.approx(0.1)
    assert max(values) == pytest.approx(1.0, abs=1e-3)
    assert values[100] == pytest.approx(0.01)
    assert values[10:] == sorted(values[10:], reverse=True)


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": 0},
        {"average": 1.0},
        {"learning_rate": 0.0},
        {"robots": ()},
        {"workers": -1},
        {"reuse": 0},
        {"minutes": 0},
    ],
)
def test_settings_out_of_range_are_refused(changes: dict):
    (name,) = changes
    with pytest.raises(
        SettingsError, match="no robot was given; give" if name == "robots" else f"{name} is .*; (allowed:|give) "
    ):
        small_config(**changes)


@pytest.mark.slow
def test_a_surface_network_learns_and_reports(tmp_path: Path):
    architecture = SurfaceArchitecture(decoder=(4, 4, 4, 4), conditioning=(4, 4))
    config = small_config(network="surface", surface_architecture=architecture, learning_rate=3e-3, steps=15)
    result = train(config, tmp_path)
    assert result.weights.name == "surface.safetensors"
    parts = {"dice_shaft", "dice_wrist", "dice_jaws", "tip_error"}
    assert set(result.validation) == {"dice", "dice_given", "part_accuracy", "normal_error_deg", *parts}
    history = json.loads(json.dumps(load_checkpoint(tmp_path).history.losses))  # pyright: ignore
    assert history[-1]["loss"] < history[0]["loss"]
    assert read_weights(result.weights).network.kind == "surface"
    assert "pixel accuracy of parts" in result.report.read_text()
