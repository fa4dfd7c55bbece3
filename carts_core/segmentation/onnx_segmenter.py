"""SAM-type segmenters from user-provided files: an encoder and a decoder as ONNX graphs.

An ONNX file describes a computation and cannot execute code. PyTorch's `.pt` and `.pth` files can, and are rejected.
Inputs and outputs are named as in the decoder export of Segment Anything and its successors.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..errors import WeightsError
from ..files.reading import WEIGHTS, Kind, open_regular, read_bytes
from ..onnx_runtime import inference_session
from ..wording import shortened
from .segmenter import Prompt

if TYPE_CHECKING:
    from ..onnx_runtime import InferenceSession

_MEAN, _DEVIATION = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
"""Mean and standard deviation by which SAM's encoders normalize images, RGB in [0, 255]."""
_INSIDE, _OUTSIDE, _CORNERS, _PADDING = 1.0, 0.0, (2.0, 3.0), -1.0
"""SAM's point labels: foreground, background, corners of a box, padding."""
_REMEDY = (
    "Give two ONNX files, the encoder first, as written by Segment Anything's export_onnx_model.py or samexporter."
)
_KNOWN = {"point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"}
"""Decoder inputs other than outputs of the encoder."""


class OnnxSegmenter:
    """SAM-type model; implements `Segmenter`. Created by `OnnxSegmenter.load`.

    Attributes:
        name: display name, from the decoder's file.
    """

    def __init__(self, encoder: "InferenceSession", decoder: "InferenceSession", side: int, name: str) -> None:
        self.name = name
        self._encoder, self._decoder, self._side = encoder, decoder, side
        self._wanted = {given.name: given for given in decoder.get_inputs()}
        self._last: tuple[np.ndarray, dict[str, np.ndarray]] | None = None

    @staticmethod
    def load(encoder: Path, decoder: Path) -> "OnnxSegmenter":
        """Load a model.

        Args:
            encoder: ONNX file; input: image `[1, 3, side, side]`; outputs: features.
            decoder: ONNX file; inputs: these features, `point_coords`, `point_labels`, and optionally `mask_input`,
                `has_mask_input` and `orig_im_size`; outputs: `masks` (logits) and, if several, `iou_predictions`.

        Raises:
            WeightsError: a file is missing, is not an ONNX graph, or contains another kind of model.
        """
        first, second = _session(encoder), _session(decoder)
        images = first.get_inputs()
        shape = list(images[0].shape) if images else []
        if (
            len(images) != 1
            or len(shape) != 4
            or shape[1] != 3
            or shape[2] != shape[3]
            or not isinstance(shape[2], int)
        ):
            raise WeightsError(
                f"{encoder} has the inputs {_listed(images)}; an encoder has one input, an image [1, 3, side, side]. "
                f"{_REMEDY}"
            )
        names = {given.name for given in second.get_inputs()}
        offered = {found.name for found in first.get_outputs()}
        missing = {"point_coords", "point_labels"} - names
        foreign = names - offered - _KNOWN
        # A single unmatched decoder input is matched with a single encoder output, regardless of their names.
        if missing or len(foreign) > 1 or (foreign and len(offered) != 1):
            raise WeightsError(
                f"{decoder} has the inputs {_listed(second.get_inputs())}, and {encoder} the outputs "
                f"{', '.join(sorted(offered))}; the inputs of a decoder are the outputs of its encoder, point_coords "
                f"and point_labels. {_REMEDY}"
            )
        if "masks" not in {found.name for found in second.get_outputs()}:
            raise WeightsError(f"{decoder} has the outputs {_listed(second.get_outputs())}, but no masks. {_REMEDY}")
        return OnnxSegmenter(first, second, shape[2], decoder.stem)

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object; see `Segmenter`.

        Raises:
            WeightsError: the model cannot be run, or its output is not a mask.
        """
        try:
            return self._segment(image, prompt)
        except (ValueError, IndexError, RuntimeError, MemoryError) as error:
            raise WeightsError(f"{self.name} cannot segment: {shortened(str(error), 300)}. {_REMEDY}") from error
        except Exception as error:  # ONNX Runtime's errors have no narrower base class.
            raise WeightsError(f"{self.name} cannot be run: {shortened(str(error), 300)}. {_REMEDY}") from error

    def _segment(self, image: np.ndarray, prompt: Prompt) -> np.ndarray:
        height, width = image.shape[:2]
        scale = self._side / max(height, width)
        points, labels = _points(prompt, scale)
        values: dict[str, np.ndarray] = {
            "point_coords": points[None],
            "point_labels": labels[None],
            "mask_input": np.zeros((1, 1, self._side // 4, self._side // 4), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array([height, width]),
        }
        features = self._features(image, scale)
        unknown = [name for name in self._wanted if name not in values and name not in features]
        if unknown:
            (features[unknown[0]],) = features.values()
        values |= features
        given = {name: _typed(values[name], wanted.type) for name, wanted in self._wanted.items()}
        found = _run(self._decoder, given)
        masks = found["masks"].astype(np.float32).reshape(-1, *found["masks"].shape[-2:])
        best = int(np.argmax(found["iou_predictions"])) if "iou_predictions" in found and len(masks) > 1 else 0
        return _at_size(masks[best], (height, width)) > 0.0

    def _features(self, image: np.ndarray, scale: float) -> dict[str, np.ndarray]:
        """Encoder features of an image, cached for further prompts on the same image."""
        if self._last is None or not np.array_equal(self._last[0], image):
            height, width = image.shape[:2]
            size = round(width * scale), round(height * scale)
            resized = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
            square = np.zeros((self._side, self._side, 3), np.float32)
            square[: size[1], : size[0]] = (resized - _MEAN) / _DEVIATION
            (given,) = self._encoder.get_inputs()
            inputs = {given.name: _typed(square.transpose(2, 0, 1)[None], given.type)}
            self._last = image.copy(), _run(self._encoder, inputs)
        return dict(self._last[1])


def _run(session: "InferenceSession", inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Run a graph and return its outputs by name."""
    names = [found.name for found in session.get_outputs()]
    values = session.run(None, dict(inputs))
    return {name: np.asarray(value) for name, value in zip(names, values, strict=True)}


def _points(prompt: Prompt, scale: float) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " points"]]:
    """Points of a prompt in pixels of the encoder's image, and their labels."""
    places = [*prompt.inside, *prompt.outside]
    kinds = [_INSIDE] * len(prompt.inside) + [_OUTSIDE] * len(prompt.outside)
    if prompt.box is not None:
        places += [prompt.box[:2], prompt.box[2:]]
        kinds += list(_CORNERS)
    else:
        # SAM's decoder was trained with a padding point for prompts without a box.
        places, kinds = [*places, (0.0, 0.0)], [*kinds, _PADDING]
    return np.array(places, np.float32) * np.float32(scale), np.array(kinds, np.float32)


def _at_size(logits: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    """Decoder mask at image size; low-resolution masks are upsampled and cropped from the padded square."""
    height, width = size
    if logits.shape == size:
        return logits
    side = max(height, width)
    return cv2.resize(logits, (side, side), interpolation=cv2.INTER_LINEAR)[:height, :width]


def _typed(value: np.ndarray, kind: str) -> np.ndarray:
    """Convert an array to the type of a graph's input."""
    types = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64}
    types |= {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
    if kind not in types:
        raise ValueError(f"an input is of type {kind}")
    return np.ascontiguousarray(value, types[kind])


def check_files(encoder: Path, decoder: Path) -> None:
    """Check that files exist and may be ONNX graphs, without loading them.

    Raises:
        WeightsError: a file is missing or a PyTorch file.
    """
    for path in (encoder, decoder):
        _read(path, lambda path, kind: open_regular(path, kind).read(2))


def _read(path: Path, read: Callable[[Path, Kind], bytes] = read_bytes) -> bytes:
    """Content of a file."""
    try:
        content = read(path, WEIGHTS)
    except (OSError, ValueError) as error:
        raise WeightsError(f"segmenter file {path} cannot be read ({shortened(str(error))}). {_REMEDY}") from error
    if content[:2] == b"PK" or content[:1] == b"\x80":
        raise WeightsError(
            f"segmenter file {path} is a PyTorch file, which could execute code on loading. Export it as ONNX. "
            f"{_REMEDY}"
        )
    return content


def _session(path: Path) -> "InferenceSession":
    try:
        return inference_session(_read(path), fold=False)
    except RuntimeError as error:
        raise WeightsError(
            f"segmenter file {path} is not an executable ONNX graph ({shortened(str(error), 300)}). {_REMEDY}"
        ) from error


def _listed(values: Sequence[Any]) -> str:
    return ", ".join(f"{value.name} {value.shape}" for value in values) or "nothing"
