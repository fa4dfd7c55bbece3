"""Networks of others: built, trained for a step, written, read, and put into the benchmark."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from carts_core.errors import SettingsError, WeightsError
from carts_core.files import output_path
from carts_core.lab.baselines.networks import Baseline, read_baseline, save_baseline
from carts_core.lab.baselines.training import (
    TrainingFrames,
    _AutoAugment,
    _Run,
    augmentation,
    make_chunk,
    prepare_frames,
    train_baseline,
)
from carts_core.networks.network import FeatureNetwork
from carts_core.settings import Architecture
from carts_core.settings.training import Augmentation, BaselineName, BaselineNetwork, BaselineTraining

SMALLEST = {
    "unet": {"unet": Architecture(widths=(4, 6, 8, 8, 8), local_mean=False)},
    "hrnet": {"decoder": (8, 8, 8, 8, 8)},
    "efficientnet": {"decoder": (8, 8, 8, 8, 8)},
    "swin": {"width": 12, "decoder": (8, 8, 8, 8, 8)},
    "colleoni": {"decoder": (8, 8, 8, 8, 8)},
}


def _smallest(name: BaselineName) -> BaselineNetwork:
    return BaselineNetwork(name, **SMALLEST[name])


class _Frames(TrainingFrames):
    """Frames with a bright square as instrument, rendered at the same position."""

    def __init__(self, count: int) -> None:
        rng = np.random.default_rng(0)
        self._images = torch.from_numpy(rng.integers(0, 90, (count, 3, 192, 256), np.uint8))
        self._masks = torch.zeros(count, 192, 256, dtype=torch.uint8)
        self._masks[:, 60:120, 80:160] = 1
        self._images[:, :, 60:120, 80:160] += 120
        self._given = torch.zeros(count, 6, 192, 256, dtype=torch.int8)
        self._given[:, 0, 60:120, 80:160] = 127


@pytest.mark.parametrize(
    "name",
    [
        "colleoni",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("unet", "hrnet", "swin", "efficientnet")),
    ],
)
def test_networks_train_save_and_load(name: BaselineName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.lab.baselines.training.VALIDATION", 4)
    training = BaselineTraining(augmentation="none", frames=104, steps=2, batch_size=2, warmup=0, threads=1)
    lines: list[str] = []
    before = Baseline(_smallest(name))
    result = train_baseline(_smallest(name), training, _Frames(8), tmp_path / "run", lines.append)
    read = read_baseline(result.weights)
    assert read.row == f"{name}_none" and read.training["steps"] == result.steps == 2
    assert read.network.settings == _smallest(name)
    changed = [
        key for key, value in read.network.state_dict().items() if not torch.equal(value, before.state_dict()[key])
    ]
    assert len(changed) > 10
    images, given, _ = _Frames(2).batch([0, 1])
    with torch.no_grad():
        logits = read.network(images.float() / 255, given)
        nowhere = read.network(images.float() / 255, 0 * given)
    assert logits.shape == (2, 1, 192, 256) and bool(logits.isfinite().all())
    assert torch.equal(logits, nowhere) is (name != "colleoni")


def test_a_u_net_finds_the_square_after_some_steps_and_a_stopped_run_goes_on(tmp_path: Path) -> None:
    def training(steps: int) -> BaselineTraining:
        return BaselineTraining(
            augmentation="none", frames=110, steps=steps, batch_size=2, warmup=0, threads=1, learning_rate=1e-2
        )

    first = train_baseline(_smallest("unet"), training(5), _Frames(110), tmp_path)
    result = train_baseline(_smallest("unet"), training(30), _Frames(110), tmp_path)
    assert (first.steps, result.steps) == (5, 30)
    assert result.dice > 0.9 and result.processor_seconds > first.processor_seconds
    with pytest.raises(SettingsError, match=r"other settings: batch_size"):
        other = BaselineTraining(augmentation="none", frames=110, batch_size=3, warmup=0, learning_rate=1e-2)
        train_baseline(_smallest("unet"), other, _Frames(110), tmp_path)


@pytest.mark.parametrize("name", ["projective", "elastic", "autoaugment"])
def test_augmentations_warp_the_rendering_as_the_image(name: Augmentation, tmp_path: Path) -> None:
    training = BaselineTraining(augmentation=name, frames=104, batch_size=16, threads=1)
    run = _Run(_smallest("unet"), training, _Frames(104), tmp_path)
    _, given, masks = run._batch()
    assert len({float(mask.sum()) for mask in masks}) > 1
    assert torch.equal(given[:, :1] > 0.5, masks > 0.5)


def test_normals_turn_with_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    change = augmentation("autoaugment", np.random.default_rng(0))
    assert isinstance(change, _AutoAugment)
    monkeypatch.setattr(change._policy, "policies", [[("Rotate", 1.0, 9)]])
    y, x = torch.meshgrid(torch.arange(-40.0, 41.0), torch.arange(-40.0, 41.0), indexing="ij")
    maps = torch.stack([torch.ones_like(x), *3 * [torch.zeros_like(x)], x, y, torch.zeros_like(x)])
    _, turned = change(torch.zeros(3, 81, 81, dtype=torch.uint8), maps)
    assert not torch.equal(turned[0], maps[0])
    assert torch.allclose(turned[4:6, 20:61, 20:61], maps[4:6, 20:61, 20:61], atol=1.0)


def test_frames_are_made_once_and_are_the_same_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.lab.baselines.training.CHUNK", 2)
    folder, said = output_path(tmp_path / "a"), list[str]()
    settings = BaselineTraining(augmentation="none", seed=5)
    object.__setattr__(settings, "frames", 3)
    frames = prepare_frames(folder, settings, said.append)
    assert said == ["training frames: part 1 of 2", "training frames: part 2 of 2"]
    make_chunk(output_path(tmp_path / "b"), 0, seed=5)
    first = tmp_path / "a" / "frames_000.safetensors"
    assert first.read_bytes() == (tmp_path / "b" / first.name).read_bytes()
    images, given, masks = frames.batch([0, 1])
    assert images.shape == (2, 3, 192, 256) and given.shape == (2, 6, 192, 256) and masks.shape == (2, 1, 192, 256)
    assert 0 < masks.mean() < 0.6 and float(given.abs().max()) <= 1.01
    with pytest.raises(WeightsError, match=r"frames_000.* with seed 5, but the seed is 6\). Delete .* another folder"):
        prepare_frames(folder, replace(settings, seed=6, frames=101), said.append)
    first.write_bytes(first.read_bytes()[:1000])
    with pytest.raises(WeightsError, match=r"frames_000.safetensors cannot be read .* Delete the file"):
        prepare_frames(folder, settings, said.append)
    assert len(said) == 2


def test_weights_of_something_else_are_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    with pytest.raises(WeightsError, match="missing"):
        read_baseline(path)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(WeightsError, match="its format is None"):
        read_baseline(path)
    network = Baseline(_smallest("unet"))
    save_baseline(network, output_path(tmp_path, "u.safetensors"), {"augmentation": "smoke"})
    assert read_baseline(tmp_path / "u.safetensors").row == "unet_smoke"
    with torch.no_grad():
        next(network.parameters()).fill_(float("nan"))
    save_baseline(network, output_path(tmp_path, "n.safetensors"), {"augmentation": "smoke"})
    with pytest.raises(WeightsError, match="not finite"):
        read_baseline(tmp_path / "n.safetensors")


def test_a_network_that_does_not_fit_its_file_is_not_created(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = Baseline(_smallest("unet"))
    network.body = torch.nn.Linear(1, 1, bias=False)
    save_baseline(network, output_path(tmp_path, "w.safetensors"), {"augmentation": "smoke"})
    devices: list[torch.device] = []

    def create(architecture: Architecture) -> FeatureNetwork:
        devices.append(torch.get_default_device())
        return FeatureNetwork(architecture)

    monkeypatch.setattr("carts_core.lab.baselines.networks.FeatureNetwork", create)
    with pytest.raises(WeightsError, match=r"is not a baseline \(body\.\S+ is missing, but should be \("):
        read_baseline(tmp_path / "w.safetensors")
    assert devices == [torch.device("meta")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "hrnet", "encoder": "hf-hub:someone/model"}, "encoder is 'hf-hub"),
        ({"name": "hrnet", "width": 48}, "only swin"),
        ({"name": "swin", "width": 50}, "multiple of 12"),
        ({"name": "unet", "decoder": (1, 2)}, "five channel counts"),
        ({"name": "unet", "size": (250, 192)}, "multiples of 32"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_words(options: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        BaselineNetwork(**options)
