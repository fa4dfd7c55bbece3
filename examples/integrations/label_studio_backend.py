"""Pre-annotate the images of a sequence in Label Studio: an ML backend that predicts a brush mask per arm.

python examples/integrations/label_studio_backend.py sequence.toml --port 9090

In Label Studio, connect http://localhost:9090 as a model (Settings > Model). The labelling interface needs brush labels
with the names of the arms, or a single label for all of them:

<View>
  <Image name="image" value="$image"/>
  <BrushLabels name="mask" toName="image"><Label value="PSM1"/></BrushLabels>
</View>

Images are matched with frames by their names and read from the sequence; the addresses in the tasks are not opened.
"""

import argparse
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from pathlib import Path
from typing import Any

from carts_core.errors import CartsError
from carts_core.evaluation import Setup
from carts_core.files.reading import parse_json, parse_xml
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FreeParameters, SurfacePredictor, SurfaceSolver
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.recording.annotations import brush_of_mask, find_frame
from carts_core.resources import sample_sequence

MODEL_VERSION = f"carts {version('carts')}"
MAX_REQUEST = 16 * 2**20
"""Maximum size of a request [bytes]."""


class Backend:
    """Predictions for tasks; frames are optimized one at a time, as by `carts optimize`."""

    def __init__(self, sequence: Sequence, predictor: FeatureExtractor | SurfacePredictor) -> None:
        self._sequence, self._predictor, self._lock = sequence, predictor, threading.Lock()

    def predict(self, tasks: list[dict[str, Any]], label_config: str) -> list[dict[str, Any]]:
        """A prediction per task, without regions if its image is not a frame of the sequence."""
        control = next(parse_xml(label_config).iter("BrushLabels"), None)
        if control is None:
            raise CartsError("The labelling interface has no BrushLabels. Add them, with the names of the arms.")
        images = {tag.get("name"): tag.get("value", "") for tag in parse_xml(label_config).iter("Image")}
        field = images[control.get("toName")].removeprefix("$")
        labels = [str(label.get("value")) for label in control.iter("Label")]
        names = {"from_name": control.get("name"), "to_name": control.get("toName"), "type": "brushlabels"}
        return [self._prediction(str(task["data"][field]), names, labels) for task in tasks]

    def _prediction(self, address: str, names: dict[str, Any], labels: list[str]) -> dict[str, Any]:
        found = find_frame(address, self._sequence)
        regions = [] if found is None else self._regions(*found, labels)
        return {"model_version": MODEL_VERSION, "result": [names | region for region in regions]}

    def _regions(self, index: int, name: str, labels: list[str]) -> list[dict[str, Any]]:
        camera = self._sequence.recorded_camera(name)
        if any(camera.distortion):
            raise CartsError(f"Camera {name!r} has distortion, but masks refer to undistorted images. Undistort them.")
        with self._lock:
            masks = self._setup(name).arm_masks(index)
        size = {"original_width": camera.width, "original_height": camera.height, "image_rotation": 0}
        regions = []
        for arm, mask in masks.items():
            label = arm if arm in labels else labels[0] if len(labels) == 1 else None
            if label is not None and mask.any():
                value = {"format": "rle", "rle": brush_of_mask(mask), "brushlabels": [label]}
                regions.append(size | {"id": f"{index}-{arm}", "value": value})
        return regions

    def _setup(self, camera: str) -> Setup:
        sequence = self._sequence
        return Setup(sequence, sequence.domains[0], (camera,), self._predictor, SurfaceSolver(), FreeParameters())


def serve(backend: Backend, host: str = "127.0.0.1", port: int = 9090) -> ThreadingHTTPServer:
    """A server of Label Studio's protocol for ML backends; `serve_forever` runs it."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._reply(200, {"status": "UP", "model_class": "CaRTS"})

        def do_POST(self) -> None:
            try:
                length = int(self.headers.get("Content-Length", 0))
                # Pages of other sites cannot send this type without permission.
                if self.headers.get_content_type() != "application/json" or not 0 < length <= MAX_REQUEST:
                    raise CartsError(f"Send JSON (application/json) of at most {MAX_REQUEST} bytes.")
                request = parse_json(self.rfile.read(length))
                if self.path == "/predict":
                    results = backend.predict(request["tasks"], request["label_config"])
                    self._reply(200, {"results": results})
                elif self.path == "/setup":
                    self._reply(200, {"model_version": MODEL_VERSION})
                else:
                    self._reply(201 if self.path == "/webhook" else 404, {})
            except (CartsError, ValueError, KeyError, TypeError, AttributeError) as error:
                self._reply(400, {"detail": f"{type(error).__name__}: {error}"})

        def _reply(self, status: int, content: dict[str, Any]) -> None:
            body = json.dumps(content).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    return ThreadingHTTPServer((host, port), Handler)


def main() -> None:
    """Serve predictions until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, nargs="?", default=sample_sequence())
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; 0.0.0.0 for other computers")
    parser.add_argument("--port", type=int, default=9090)
    arguments = parser.parse_args()
    backend = Backend(Sequence.open(arguments.sequence, progress=print), FeatureExtractor.load(inference="auto"))
    with serve(backend, arguments.host, arguments.port) as server:
        print(f"listening on http://{arguments.host}:{arguments.port}")
        server.serve_forever()


if __name__ == "__main__":
    tune_process()
    main()
