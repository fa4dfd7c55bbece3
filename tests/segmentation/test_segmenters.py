"""Segmentation from clicks and boxes, by the shipped segmenter and by SAM-type ONNX models."""

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from carts_core.cli.view import View
from carts_core.errors import SettingsError, WeightsError
from carts_core.evaluation.metrics import dice
from carts_core.networks import FeatureExtractor
from carts_core.networks.surface import UNetSurface
from carts_core.networks.weights import save_weights
from carts_core.recording import Sequence
from carts_core.segmentation import NetworkSegmenter, Prompt, Segmenter, instrument_probability, onnx_segmenter
from carts_core.segmentation.onnx_segmenter import OnnxSegmenter
from carts_core.settings import Architecture

HEIGHT, WIDTH = 120, 160
LEFT, RIGHT = (slice(30, 90), slice(20, 60)), (slice(20, 100), slice(100, 140))


def _two_bars() -> np.ndarray:
    """Two grey bars on red, with some noise."""
    image = np.full((HEIGHT, WIDTH, 3), (150, 50, 40), np.uint8)
    image[LEFT] = image[RIGHT] = (130, 140, 145)
    noise = np.random.default_rng(0).integers(-6, 7, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _mask(*parts: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for part in parts:
        mask[part] = True
    return mask


def _roughly(*parts: tuple[slice, slice]) -> Segmenter:
    """As if a network saw these parts, a pixel too small all round."""
    seen = cv2.erode(_mask(*parts).astype(np.uint8), np.ones((3, 3), np.uint8))
    return NetworkSegmenter(lambda image: seen.astype(np.float32))


def test_a_click_gives_the_whole_thing_along_its_edges_and_nothing_else() -> None:
    found = _roughly(LEFT, RIGHT).segment(_two_bars(), Prompt(inside=((40.5, 60.5),)))
    assert dice(found, _mask(LEFT)) > 0.99 and not (found & _mask(RIGHT)).any()


def test_a_network_gets_images_of_the_size_of_its_own_weights(
    tmp_path: Path, small_architecture: Architecture, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_weights(UNetSurface(small_architecture).eval(), tmp_path / "surface.safetensors", {}, (80, 64))
    extractor, sizes = FeatureExtractor.load(tmp_path / "surface.safetensors"), list[torch.Size]()
    surface = extractor.surface

    def recording(images: Tensor, given: Tensor) -> Tensor:
        sizes.append(images.shape[2:])
        return surface(images, given)

    monkeypatch.setattr(extractor, "surface", recording)
    assert instrument_probability(extractor, _two_bars()).shape == (HEIGHT, WIDTH)
    assert sizes == [(64, 80)]


def test_two_clicks_give_both_things_and_a_point_beside_takes_one_away_again() -> None:
    segmenter, image = _roughly(LEFT, RIGHT), _two_bars()
    both = ((40.5, 60.5), (120.5, 60.5))
    assert dice(segmenter.segment(image, Prompt(inside=both)), _mask(LEFT, RIGHT)) > 0.99
    one = segmenter.segment(image, Prompt(inside=both[:1], outside=both[1:]))
    assert dice(one, _mask(LEFT)) > 0.99 and not (one & _mask(RIGHT)).any()


def test_a_box_gives_what_is_in_it() -> None:
    found = _roughly(LEFT, RIGHT).segment(_two_bars(), Prompt(box=(95.0, 15.0, 145.0, 105.0)))
    assert dice(found, _mask(RIGHT)) > 0.99


@pytest.mark.parametrize("prompt", [Prompt(inside=((40.5, 60.5),)), Prompt(box=(12.0, 22.0, 68.0, 98.0))])
def test_where_the_network_sees_nothing_colour_and_edges_decide(prompt: Prompt) -> None:
    found = _roughly().segment(_two_bars(), prompt)
    assert dice(found, _mask(LEFT)) > 0.97


def test_the_network_is_asked_once_for_an_image() -> None:
    asked: list[np.ndarray] = []

    def probability(image: np.ndarray) -> np.ndarray:
        asked.append(image)
        return _mask(LEFT).astype(np.float32)

    segmenter, image = NetworkSegmenter(probability), _two_bars()
    for u in (30.5, 40.5, 50.5):
        segmenter.segment(image.copy(), Prompt(inside=((u, 60.5),)))
    assert len(asked) == 1
    segmenter.segment(255 - image, Prompt(inside=((40.5, 60.5),)))
    assert len(asked) == 2


def test_the_encoder_runs_again_for_a_changed_image_only(
    model: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    segmenter, image, runs = OnnxSegmenter.load(*model), _half_bright(), []
    run = onnx_segmenter._run
    monkeypatch.setattr(onnx_segmenter, "_run", lambda session, given: runs.append(given) or run(session, given))
    prompt = Prompt(inside=((52.0, 24.0),))
    assert segmenter.segment(image, prompt).any() and segmenter.segment(image.copy(), prompt).any()
    assert len(runs) == 3
    image[:] = 0
    assert not segmenter.segment(image, prompt).any()
    assert len(runs) == 5


def test_a_click_on_each_instrument_of_the_shipped_recording_gives_its_mask(sample_sequence_path: Path) -> None:
    sequence = Sequence.open(sample_sequence_path)
    camera = sequence.scene.cameras[0].name
    frame = sequence.frame(0, "regular", [camera])
    assert frame.masks is not None
    image, truth = frame.images[camera], frame.masks[camera]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(truth.astype(np.uint8))
    things = [labels == number for number in range(1, count) if stats[number, cv2.CC_STAT_AREA] > 3000]
    assert len(things) == 2
    segmenter = NetworkSegmenter.of(FeatureExtractor.load())
    for thing in things:
        depth = cv2.distanceTransform(thing.astype(np.uint8), cv2.DIST_L2, 5)
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        found = segmenter.segment(image, Prompt(inside=((float(column) + 0.5, float(row) + 0.5),)))
        assert dice(found, thing) > 0.88


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Prompt, "needs a point"),
        (lambda: Prompt(outside=((1.0, 2.0),)), "needs a point"),
        (lambda: Prompt(inside=((1.0, float("nan")),)), "not finite"),
        (lambda: Prompt(box=(5.0, 5.0, 5.0, 9.0)), "is empty"),
        (lambda: Prompt(inside=((1.0, 1.0),) * 101), "at most 100"),
    ],
)
def test_a_prompt_that_says_nothing_is_refused(make: Callable[[], Prompt], reason: str) -> None:
    with pytest.raises(SettingsError, match=reason):
        make()


SIDE, REACH = 64, 12.0


class Encoder(nn.Module):
    """Brightness at a quarter of the resolution, where a SAM has its image embedding."""

    def forward(self, image: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(image.mean(1, keepdim=True), 4)


class Decoder(nn.Module):
    """Bright pixels near a point on the thing, or in the box, that are not near a point beside it."""

    def forward(self, image_embeddings: Tensor, point_coords: Tensor, point_labels: Tensor, mask_input: Tensor,
                has_mask_input: Tensor, orig_im_size: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        axis = torch.arange(SIDE) + 0.5
        x, y = axis.view(1, 1, SIDE), axis.view(1, SIDE, 1)
        u, v = point_coords[0, :, 0].view(-1, 1, 1), point_coords[0, :, 1].view(-1, 1, 1)
        labels = point_labels[0].view(-1, 1, 1)
        near = REACH - torch.sqrt((x - u) ** 2 + (y - v) ** 2)
        nowhere = torch.full_like(near, -99.0)
        inside = torch.where(labels == 1, near, nowhere).amax(0)
        outside = torch.where(labels == 0, near, nowhere).amax(0)
        first = torch.where(labels == 2, torch.minimum(x - u, y - v), nowhere).amax(0)
        last = torch.where(labels == 3, torch.minimum(u - x, v - y), nowhere).amax(0)
        bright = nn.functional.interpolate(image_embeddings, scale_factor=4.0, mode="nearest")[0, 0]
        meant = torch.maximum(inside, torch.minimum(first, last))
        logits = torch.minimum(torch.minimum(meant, -outside), 10.0 * bright) + 0.0 * mask_input.sum()
        empty = torch.full_like(logits, -5.0) + 0.0 * has_mask_input.sum() + 0.0 * orig_im_size.sum()
        masks = torch.stack([empty, logits])[None]
        return masks, torch.tensor([[0.1, 0.9]]), masks


def _export(path: Path, module: nn.Module, inputs: dict[str, Tensor], outputs: list[str], **axes: dict) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.eval(), tuple(inputs.values()), str(path), input_names=list(inputs), output_names=outputs,
            dynamic_axes=axes, opset_version=17, dynamo=False,
        )  # fmt: skip
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Encoder and decoder, with the names and shapes of Segment Anything's own export."""
    folder = tmp_path_factory.mktemp("model")
    encoder = _export(folder / "encoder.onnx", Encoder(), {"image": torch.rand(1, 3, SIDE, SIDE)}, ["embedding"])
    inputs = {
        "image_embeddings": torch.rand(1, 1, SIDE // 4, SIDE // 4),
        "point_coords": torch.rand(1, 3, 2),
        "point_labels": torch.tensor([[1.0, 0.0, -1.0]]),
        "mask_input": torch.zeros(1, 1, SIDE // 4, SIDE // 4),
        "has_mask_input": torch.zeros(1),
        "orig_im_size": torch.tensor([48.0, 96.0]),
    }
    axes = {"point_coords": {1: "points"}, "point_labels": {1: "points"}}
    names = ["masks", "iou_predictions", "low_res_masks"]
    return encoder, _export(folder / "decoder.onnx", Decoder(), inputs, names, **axes)


def _half_bright() -> np.ndarray:
    image = np.zeros((48, 96, 3), np.uint8)
    image[:, 48:] = 255
    return image


def _disc(u: float, v: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:48, :96] + 0.5
    return np.hypot(columns - u, rows - v) < radius


def _dice(one: np.ndarray, other: np.ndarray) -> float:
    return float(2 * (one & other).sum() / (one.sum() + other.sum()))


def test_prompts_are_scaled_to_the_decoder_and_masks_back(model: tuple[Path, Path]) -> None:
    segmenter, image = OnnxSegmenter.load(*model), _half_bright()
    bright = np.zeros((48, 96), bool)
    bright[:, 48:] = True
    # 96 pixels are 64 of the model's, so its reach of 12 is 18 of ours.
    found = segmenter.segment(image, Prompt(inside=((52.0, 24.0),)))
    assert found.shape == (48, 96) and _dice(found, _disc(52, 24, 18) & bright) > 0.93
    both = segmenter.segment(image, Prompt(inside=((60.0, 24.0),), outside=((78.0, 24.0),)))
    assert _dice(both, _disc(60, 24, 18) & bright & ~_disc(78, 24, 18)) > 0.93
    boxed = segmenter.segment(image, Prompt(box=(30.0, 9.0, 72.0, 39.0)))
    wanted = np.zeros((48, 96), bool)
    wanted[9:39, 48:72] = True
    assert _dice(boxed, wanted) > 0.93
    # A dark image has nothing for it.
    assert not segmenter.segment(np.zeros_like(image), Prompt(inside=((52.0, 24.0),))).any()


def test_files_of_pytorch_are_refused_before_anything_of_them_is_run(model: tuple[Path, Path], tmp_path: Path) -> None:
    for name, save in (
        ("pickle.pth", lambda path: torch.save({"weights": torch.zeros(3)}, path)),
        ("script.pt", lambda path: torch.jit.save(torch.jit.script(nn.ReLU()), str(path))),
        ("old.pth", lambda path: torch.save({}, path, _use_new_zipfile_serialization=False)),
    ):
        path = tmp_path / name
        save(path)
        with pytest.raises(WeightsError, match=rf"{name} is a PyTorch file, .*Export it as ONNX"):
            OnnxSegmenter.load(path, model[1])


def test_other_models_are_refused_with_the_expected_inputs(model: tuple[Path, Path], tmp_path: Path) -> None:
    encoder, decoder = model
    with pytest.raises(
        WeightsError, match=r"an encoder has one input, an image .*Give two ONNX files, the encoder first"
    ):
        OnnxSegmenter.load(decoder, encoder)
    with pytest.raises(WeightsError, match=r"inputs image .*point_coords and point_labels"):
        OnnxSegmenter.load(encoder, encoder)
    with pytest.raises(WeightsError, match="cannot be read"):
        OnnxSegmenter.load(tmp_path / "none.onnx", decoder)
    text = tmp_path / "text.onnx"
    text.write_text("no graph")
    with pytest.raises(WeightsError, match="not an executable ONNX graph"):
        OnnxSegmenter.load(text, decoder)


_PROMPT = """
import json, sys
from pathlib import Path

import numpy as np
import carts_core.cli.command_line
from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.strokes import Stroke, Target

path, encoder, decoder = map(Path, sys.argv[1:4])
found = []
for files in ((encoder, decoder), (decoder, encoder)):
    with ViewerApp.open(path, port=0, segmenter=files) as app:
        points = np.array([json.loads(sys.argv[4])])
        app.queue.put(intents.Paint(7, Stroke(1, 0, "left", Target.IGNORE, False, False, 1, points, prompt=True)))
        state = app.wait_until_shown()
        region = state.project.get(Key.ignore_region(0, "left"))
        found.append([state.error, None if region is None else region.region().tolist()])
print(json.dumps([found, "torch" in sys.modules, "onnxruntime" in sys.modules]))
"""


def test_a_model_for_the_page_runs_in_the_solver_process(
    model: tuple[Path, Path], tiny_sequence: Callable[..., Path]
) -> None:
    path = tiny_sequence()
    image = Sequence.open(path).frame(0).images["left"]
    v, u = np.unravel_index(cv2.blur(image, (9, 9)).sum(-1).argmax(), image.shape[:2])
    place = float(u) + 0.5, float(v) + 0.5
    command = [sys.executable, "-c", _PROMPT, str(path), *map(str, model), json.dumps(place)]
    said = subprocess.check_output(command, text=True, timeout=120)
    ((error, region), (refused, unchanged)), *imported = json.loads(said.splitlines()[-1])
    wanted = OnnxSegmenter.load(*model).segment(image, Prompt(inside=(place,)))
    assert error is None and wanted.any() and np.array_equal(region, wanted)
    assert "an encoder has one input, an image" in refused and unchanged == region
    assert imported == [False, False]


def test_unreadable_files_are_refused_before_the_page_is_served(tmp_path: Path) -> None:
    (tmp_path / "pickle.pth").write_bytes(b"\x80\x02")
    for name, reason in (("pickle.pth", "is a PyTorch file"), ("none.onnx", "cannot be read")):
        with pytest.raises(WeightsError, match=reason):
            View(tmp_path / "sequence.toml", segmenter=(tmp_path / name, tmp_path / name)).run()
