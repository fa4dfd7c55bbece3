"""The integrations in `examples` speak the protocols of other programs."""

import json
import runpy
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carts_core.optimization import FrameOptimizer, MaskPredictor
from carts_core.recording import Sequence
from carts_core.recording.annotations import brush_of_mask, find_frame, read_annotations
from carts_core.recording.annotations.label_studio import opacity_of_brush
from carts_core.rendering import Renderer

BACKEND = Path(__file__).resolve().parents[2] / "examples" / "integrations" / "label_studio_backend.py"
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
        optimizer = FrameOptimizer(sequence.scene, sequence.frame(index), {}, MaskPredictor())
        for _ in optimizer:
            pass
        assert optimizer.best is not None
        wanted = Renderer(sequence.scene).segment(optimizer.best.state)[0] >= 0
        assert np.array_equal(labels[index] == 1, wanted)


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
