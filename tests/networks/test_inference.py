"""ONNX Runtime runs the surface network as torch does, or quantized with a small difference, or not at all."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.imaging.working_image import stacked_images
from carts_core.model.parts import COVERAGE
from carts_core.networks import FeatureExtractor
from carts_core.networks.engines import TOLERANCE
from carts_core.networks.surface import UNetSurface
from carts_core.networks.weights import save_weights
from carts_core.onnx_runtime import exact_int8
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from carts_core.settings import Architecture


@pytest.fixture(scope="module")
def weights(small_architecture: Architecture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(3)
    network = UNetSurface(small_architecture)
    with torch.no_grad():
        for _ in range(5):
            network(torch.rand(4, 3, 32, 48), torch.rand(4, 6, 32, 48))
    path = tmp_path_factory.mktemp("weights") / "surface.safetensors"
    save_weights(network.eval(), path, {}, (320, 240))
    return path


@pytest.fixture(scope="module")
def graphs(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with the graphs of both networks, which take seconds to export."""
    folder = tmp_path_factory.mktemp("graphs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARTS_CACHE", str(folder))
        FeatureExtractor.load(inference="onnx")
        FeatureExtractor.load(weights, inference="onnx")
    return folder


@pytest.fixture(autouse=True)
def cache(graphs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache, with exported graphs."""
    folder = tmp_path / "cache"
    folder.mkdir()
    for graph in graphs.glob("surface-*.onnx"):
        shutil.copy(graph, folder)
    monkeypatch.setenv("CARTS_CACHE", str(folder))
    return folder


@pytest.mark.parametrize("size", [(16, 16), (112, 208), (240, 320)])
@pytest.mark.parametrize("shipped", [False, True])
def test_onnx_predicts_what_torch_predicts(weights: Path, size: tuple[int, int], shipped: bool) -> None:
    files = [] if shipped else [weights]
    one, other = FeatureExtractor.load(*files), FeatureExtractor.load(*files, inference="onnx")
    assert (one.engine, other.engine) == ("torch", "onnx")
    assert one.sha256 == other.sha256 == one.fingerprint != other.fingerprint
    images, given = torch.rand(2, 3, *size), torch.rand(2, 6, *size)
    expected, found = one.surface(images, given), other.surface(images, given)
    assert float((expected - found).abs().max()) < TOLERANCE and float(expected.std()) > 1e-3
    # A part of a larger tensor, which is not contiguous.
    window = images[..., : size[0] // 2 // 16 * 16 or 16, :]
    torch.testing.assert_close(
        other.surface(window, given[..., : window.shape[2], :]),
        one.surface(window, given[..., : window.shape[2], :]),
        atol=1e-4,
        rtol=0,
    )


def test_onnx_takes_images_that_require_gradients_as_torch_does(weights: Path) -> None:
    images, given = torch.rand(1, 3, 16, 16, requires_grad=True), torch.rand(1, 6, 16, 16)
    for inference in ("torch", "onnx"):
        assert not FeatureExtractor.load(weights, inference=inference).surface(images, given).requires_grad


@pytest.mark.gpu
def test_a_gpu_predicts_what_a_cpu_predicts_and_gives_it_back_where_the_images_are() -> None:
    images, given = torch.rand(1, 3, 112, 208), torch.rand(1, 6, 112, 208)
    here, there = (FeatureExtractor.load(device=device).surface(images, given) for device in ("cpu", "cuda"))
    torch.testing.assert_close(there, here, atol=TOLERANCE, rtol=0)


def test_a_damaged_graph_is_exported_again(weights: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graphs = {path: path.read_bytes() for path in cache.glob("surface-*.onnx")}
    monkeypatch.setattr("carts_core.networks.engines.exported", lambda network: pytest.fail("exported again"))
    assert FeatureExtractor.load(weights, inference="onnx").engine == "onnx"
    monkeypatch.undo()
    monkeypatch.setenv("CARTS_CACHE", str(cache))
    for path, whole in graphs.items():
        path.write_bytes(whole[:1000])
    assert FeatureExtractor.load(weights, inference="onnx").engine == "onnx"
    # The graph of the other network is not touched.
    assert sorted(path.read_bytes() == whole for path, whole in graphs.items()) == [False, True]


def test_another_networks_graph_is_not_used(weights: Path, cache: Path) -> None:
    one, other = cache.glob("surface-*.onnx")
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])
    assert FeatureExtractor.load(weights, inference="auto").engine == "torch"
    with pytest.raises(SettingsError, match=r"cannot be used: (its surface maps differ|ONNX Runtime cannot run)"):
        FeatureExtractor.load(weights, inference="onnx")


@pytest.mark.parametrize(
    ("onnx", "int8", "engine"),
    [(0.5, 0.3, "int8"), (0.5, 0.47, "onnx"), (0.95, 0.92, "torch"), (2.0, 0.8, "int8"), (2.0, 2.0, "torch")],
)
def test_the_fastest_engine_is_measured_once_and_remembered(
    cache: Path, monkeypatch: pytest.MonkeyPatch, onnx: float, int8: float, engine: str
) -> None:
    seconds = {"torch": 1.0, "onnx": onnx, "int8": int8}
    # On processors where sums of 8-bit products saturate, the quantized network would not be measured.
    monkeypatch.setattr("carts_core.networks.engines.exact_int8", lambda: True)
    monkeypatch.setattr("carts_core.networks.engines._deviation", lambda network, other: 0.0)
    monkeypatch.setattr("carts_core.networks.engines._times", lambda network, engines: seconds)
    assert FeatureExtractor.load(inference="auto").engine == engine
    (remembered,) = cache.glob("inference-*.json")
    assert json.loads(remembered.read_text())["engine"] == engine
    monkeypatch.setattr("carts_core.networks.engines._times", lambda network, engines: pytest.fail("measured again"))
    assert FeatureExtractor.load(inference="auto").engine == engine


@pytest.mark.skipif(not exact_int8(), reason="sums of 8-bit products saturate on this processor")
def test_the_quantized_network_predicts_nearly_what_torch_predicts() -> None:
    sequence = Sequence.open(sample_sequence())
    scene = sequence.scene
    one, other = FeatureExtractor.load(), FeatureExtractor.load(inference="int8")
    assert (other.engine, one.sha256) == ("int8", other.sha256) and one.fingerprint != other.fingerprint
    renderer = Renderer(scene, width=320, height=240)
    for domain in sequence.domains:
        frame = sequence.frame(5, domain)
        given = renderer.surface_maps(scene.state(frame.measured))
        images = stacked_images(scene, frame.images, (320, 240), "image")
        expected, found = one.surface(images, given), other.surface(images, given)
        difference = (expected - found)[:, COVERAGE]
        assert 1e-4 < float(difference.square().mean().sqrt()) < 0.015, domain
        ours, theirs = (maps[:, COVERAGE].sum(1) > 0.5 for maps in (found, expected))
        assert 2 * int((ours & theirs).sum()) > 0.97 * int(ours.sum() + theirs.sum()), domain


def test_where_sums_of_8_bit_products_saturate_the_network_is_not_quantized(monkeypatch: pytest.MonkeyPatch) -> None:
    class Saturating:
        """As x86 processors without VNNI: sums of two products have 16 bits."""

        def run(self, outputs: list[str], factors: dict[str, np.ndarray]) -> list[np.ndarray]:
            a, b = (factors[name].astype(np.int64) for name in "ab")
            pairs = a[:, None, ::2] * b.T[None, :, ::2] + a[:, None, 1::2] * b.T[None, :, 1::2]
            return [pairs.clip(-(2**15), 2**15 - 1).sum(2).astype(np.int32)]

    monkeypatch.setattr("carts_core.onnx_runtime.inference_session", lambda *_: Saturating())
    assert not exact_int8()
    assert FeatureExtractor.load(inference="auto").engine in ("torch", "onnx")
    with pytest.raises(SettingsError, match="cannot be used: sums of 8-bit products saturate on this processor"):
        FeatureExtractor.load(inference="int8")


def test_weights_without_a_quantized_graph_are_refused_or_run_in_another_engine(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carts_core.networks.engines.exact_int8", lambda: True)
    with pytest.raises(SettingsError, match="cannot be used: only the shipped weights have a quantized graph"):
        FeatureExtractor.load(weights, inference="int8")
    assert FeatureExtractor.load(weights, inference="auto").engine in ("torch", "onnx")


def test_without_onnx_runtime_torch_runs(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.networks.engines.find_spec", lambda name: None)
    assert FeatureExtractor.load(weights, inference="auto").engine == "torch"
    with pytest.raises(SettingsError, match="onnxruntime and onnx are not installed"):
        FeatureExtractor.load(weights, inference="onnx")


def test_a_cache_that_cannot_be_written_is_no_error(weights: Path, cache: Path) -> None:
    shutil.rmtree(cache)
    cache.write_text("a file where the folder should be")
    assert FeatureExtractor.load(weights, inference="onnx").engine == "onnx"


@pytest.mark.parametrize("ours", [True, False])
def test_onnx_runtime_collects_nothing_about_whoever_uses_it(cache: Path, tmp_path: Path, ours: bool) -> None:
    """What it would send it keeps in a database in the user's cache first; without our import it does."""
    graph = next(cache.glob("surface-*.onnx"))
    session = f"import onnxruntime; onnxruntime.InferenceSession({str(graph)!r}, providers=['CPUExecutionProvider'])"
    if ours:
        session = f"from carts_core.onnx_runtime import *; inference_session(open({str(graph)!r}, 'rb').read())"
    # It collects nothing where it finds that it runs in a test.
    environment = {name: value for name, value in os.environ.items() if name in ("PATH", "PYTHONPATH", "LANG")}
    home = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home" / "cache")}
    (tmp_path / "home").mkdir()
    subprocess.run([sys.executable, "-c", session], env=environment | home, check=True)
    kept = [path.name for path in (tmp_path / "home").rglob("onnxruntime.db")]
    assert kept == ([] if ours else ["onnxruntime.db"])
