"""SAM-type models as ONNX files: prompts reach the decoder as SAM has them, and other files are refused."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from carts_core.errors import WeightsError
from carts_core.segmentation import Prompt
from carts_core.segmentation.onnx_segmenter import OnnxSegmenter

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
