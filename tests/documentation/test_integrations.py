"""The integrations in `examples` speak the protocols of other programs."""

import io
import json
import logging
import runpy
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.export.encodings import polygons
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer, MaskPredictor
from carts_core.recording import Sequence
from carts_core.recording.annotations import brush_of_mask, find_frame, read_annotations
from carts_core.recording.annotations.label_studio import opacity_of_brush
from carts_core.rendering import Renderer

INTEGRATIONS = Path(__file__).resolve().parents[2] / "examples" / "integrations"
BACKEND = INTEGRATIONS / "label_studio_backend.py"
CONFIG = (
    '<View><Image name="img" value="$picture"/><BrushLabels name="mask" toName="img">'
    '<Label value="PSM1"/><Label value="{arm}"/></BrushLabels></View>'
)


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=2, width=160, height=128))


@pytest.fixture
def url(sequence: Sequence) -> Iterator[str]:
    example = runpy.run_path(str(BACKEND))
    with example["serve"](example["Backend"](sequence, MaskPredictor()), port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def ask(url: str, content: Any = None, kind: str = "application/json") -> tuple[int, Any]:
    """Status and content of the reply; a GET without content."""
    body = None if content is None else json.dumps(content).encode()
    request = urllib.request.Request(url, body, {"Content-Type": kind})
    try:
        with urllib.request.urlopen(request, timeout=60) as reply:
            return reply.status, json.load(reply)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def optimized(sequence: Sequence, index: int) -> np.ndarray:
    """Mask of a frame as `carts optimize` writes it."""
    optimizer = FrameOptimizer(sequence.scene, sequence.frame(index), {}, MaskPredictor())
    for _ in optimizer:
        pass
    assert optimizer.best is not None
    return Renderer(sequence.scene).segment(optimizer.best.state)[0] >= 0


def test_label_studio_gets_the_masks_of_the_optimizer(url: str, sequence: Sequence, tmp_path: Path) -> None:
    assert ask(f"{url}/health") == (200, {"status": "UP", "model_class": "CaRTS"})
    arm = sequence.scene.arms[0].name
    config = CONFIG.format(arm=arm)
    assert ask(f"{url}/setup", {"project": "3", "schema": config})[0] == 200
    names = ("/data/upload/3/1a2b3c4d-002.png", "/data/local-files/?d=left/001.png", "s3://bucket/other.png")
    tasks = [{"id": number, "data": {"picture": name}} for number, name in enumerate(names)]
    status, reply = ask(f"{url}/predict", {"tasks": tasks, "label_config": config, "project": "3.1", "params": {}})
    assert status == 200 and [len(each["result"]) for each in reply["results"]] == [1, 1, 0]
    exported = [task | {"annotations": [each]} for task, each in zip(tasks, reply["results"], strict=True)]
    (tmp_path / "tasks.json").write_text(json.dumps(exported))
    found = read_annotations(tmp_path / "tasks.json", sequence)
    labels = {frame.frame: frame.labels for frame in found.frames}
    assert found.label_names == [arm] and sorted(labels) == [0, 1]
    for index in (0, 1):
        assert np.array_equal(labels[index] == 1, optimized(sequence, index))


@pytest.mark.parametrize(
    ("path", "content", "kind", "message"),
    [
        ("/predict", {"tasks": []}, "application/json", "label_config"),
        ("/predict", {"tasks": [], "label_config": "<View/>"}, "application/json", "has no BrushLabels"),
        ("/predict", {"tasks": [], "label_config": "<!DOCTYPE a>"}, "application/json", "declares a document type"),
        ("/predict", {"tasks": [], "label_config": "<View/>"}, "text/plain", r"Send JSON"),
        ("/predict", [], "application/json", "TypeError"),
    ],
)
def test_invalid_requests_are_answered(url: str, path: str, content: Any, kind: str, message: str) -> None:
    status, reply = ask(url + path, content, kind)
    assert status == 400 and message in reply["detail"]


@pytest.mark.parametrize("seed", range(3))
def test_encoded_brush_masks_come_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for mask in (rng.random((60, 80)) < 0.3, np.zeros((300, 400), bool), np.ones((300, 400), bool)):
        assert np.array_equal(opacity_of_brush(brush_of_mask(mask), *mask.shape) == 255, mask)


def test_frames_are_found_by_addresses_of_images(sequence: Sequence) -> None:
    assert find_frame("https://example.org/data/upload/3/1a2b3c4d-frame_002.png?token=77", sequence) == (1, "left")
    assert find_frame("../../etc/passwd", sequence) is None


def cvat(sequence: Sequence, predictor: Any) -> tuple[Any, Any]:
    """Detection and tracking of the example."""
    pytest.importorskip("cvat_sdk")
    example = runpy.run_path(str(INTEGRATIONS / "cvat_function.py"))
    masks = example["Masks"](sequence, predictor)
    return example["Detection"](masks), example["Tracking"](masks)


def detected(detection: Any, name: str, image: Image.Image, *, to_polygons: bool = False) -> list[Any]:
    """Shapes that CVAT accepts from a detection, in a task that lists the labels in another order."""
    from cvat_sdk import models  # noqa: PLC0415
    from cvat_sdk.auto_annotation import driver  # noqa: PLC0415

    kind = "polygon" if to_polygons else "mask"
    labels: Any = [
        models.Label(id=100 - label.id, name=label.name, type=kind, attributes=[], sublabels=[])
        for label in detection.spec.labels
    ]
    mapper = driver._AnnotationMapper(
        logging.getLogger(), detection.spec.labels, labels, allow_unmatched_labels=False, conv_mask_to_poly=to_polygons
    )
    context = driver._DetectionFunctionContextImpl(frame_name=name, conv_mask_to_poly=to_polygons)
    tags, shapes = mapper.validate_and_remap(detection.detect(context, image), 7)
    assert not tags and all(shape.frame == 7 for shape in shapes)
    return shapes


def tracked(tracking: Any, image: Image.Image, state: str, kind: str) -> Any:
    from cvat_sdk import auto_annotation  # noqa: PLC0415

    class Context(auto_annotation.TrackingFunctionShapeContext):
        @property
        def original_shape_type(self) -> str:
            return kind

    return tracking.track(Context(), tracking.preprocess_image(auto_annotation.TrackingFunctionContext(), image), state)


def as_jpeg(image: np.ndarray) -> Image.Image:
    """The image as CVAT sends it: compressed."""
    compressed = io.BytesIO()
    Image.fromarray(image).save(compressed, "JPEG", quality=70)
    return Image.open(compressed)


def mask_of(shape: Any, image: Image.Image) -> np.ndarray:
    from cvat_sdk.masks import decode_mask  # noqa: PLC0415

    return decode_mask(shape.points, image_width=image.width, image_height=image.height)


def test_cvat_gets_the_masks_of_the_optimizer(sequence: Sequence) -> None:
    detection, _ = cvat(sequence, MaskPredictor())
    image = as_jpeg(sequence.frame(1).images["left"])
    (shape,) = detected(detection, "data/left/002.png", image)
    assert shape.label_id == 100 and np.array_equal(mask_of(shape, image), optimized(sequence, 1))
    outlines = detected(detection, "002.png", image, to_polygons=True)
    assert [shape.points for shape in outlines] == [
        (outline + 0.5).ravel().tolist() for outline in polygons(optimized(sequence, 1))
    ]
    assert detected(detection, "other.png", image) == []
    with pytest.raises(CartsError, match=r"has 80 x 64 pixels.*original size"):
        detected(detection, "002.png", image.resize((80, 64)))


def test_cvat_tracks_an_arm_through_the_images(sequence: Sequence) -> None:
    from_sdk = pytest.importorskip("cvat_sdk.auto_annotation")
    _, tracking = cvat(sequence, MaskPredictor())
    first, second = (as_jpeg(sequence.frame(index).images["left"]) for index in (0, 1))
    places = [tracking.preprocess_image(from_sdk.TrackingFunctionContext(), image) for image in (first, second)]
    assert places == [(0, "left"), (1, "left")]
    rows, columns = np.nonzero(optimized(sequence, 0))
    middle = np.array([columns.mean(), rows.mean()])
    drawn = from_sdk.TrackableShape(type="polygon", points=(middle + 9 * np.array([[-1, -1], [1, -1], [0, 1]])).ravel())
    state = tracking.init_tracking_state(None, places[0], drawn)
    assert state == sequence.scene.arms[0].name
    assert np.array_equal(mask_of(tracked(tracking, second, state, "mask"), second), optimized(sequence, 1))
    outline = np.array(tracked(tracking, second, state, "polygon").points).reshape(-1, 2)
    assert any(np.array_equal(outline, each + 0.5) for each in polygons(optimized(sequence, 1)))
    other = Image.fromarray(255 - np.asarray(second))
    assert tracked(tracking, other, state, "mask") is None
    with pytest.raises(CartsError, match="covers none of the arms"):
        outside = from_sdk.TrackableShape(type="polygon", points=[0.0, 0.0, 2.0, 0.0, 2.0, 2.0])
        tracking.init_tracking_state(None, places[0], outside)
    with pytest.raises(CartsError, match="is no frame of"):
        tracking.init_tracking_state(None, None, drawn)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_masks_of_real_frames_are_those_of_carts_optimize(shared_dir: Path, tmp_path: Path) -> None:
    file = Path(__file__).resolve().parents[1] / "sequences" / "dvrk_stereo.toml"
    main(["optimize", str(file), "--camera", "left", "--output", str(tmp_path)])
    sequence = Sequence.open(file)
    predictor = FeatureExtractor.load(inference="auto")
    detection, tracking = cvat(sequence, predictor)
    backend = runpy.run_path(str(BACKEND))["Backend"](sequence, predictor)
    names = [f"/data/upload/1/abcd-left_{frame}.jpg" for frame in sequence.frame_ids]
    predictions = backend.predict([{"data": {"picture": name}} for name in names], CONFIG.format(arm="other"))
    state = sequence.scene.arms[0].name
    for index, name in enumerate(names):
        mask = cv2.imread(str(tmp_path / "regular/left/masks" / f"{sequence.frame_ids[index]}.png"), 0) == 255
        image = as_jpeg(sequence.frame(index).images["left"])
        assert np.array_equal(mask_of(detected(detection, name, image)[0], image), mask)
        assert np.array_equal(mask_of(tracked(tracking, image, state, "mask"), image), mask)
        brush = predictions[index]["result"][0]["value"]["rle"]
        assert np.array_equal(opacity_of_brush(brush, *mask.shape) == 255, mask)
    assert len(names) == 30
