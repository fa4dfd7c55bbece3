"""The page requires no PyTorch: overlay, edits, review, exports, and results of the solver process."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

_USE = """
import json, sys
from pathlib import Path

sys.modules["torch"] = None  # Every import of PyTorch fails.
import carts_core.cli.command_line
from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.overlay import OverlayRenderer

with ViewerApp.open(Path(sys.argv[1]), project=Path(sys.argv[2]), port=0) as app:
    arm, camera = app.scene.arms[0].name, app.scene.cameras[0]
    app.queue.put(intents.SetJoint(arm, 0, 0.02))
    app.queue.put(intents.Released())
    ids = OverlayRenderer(app.sequence).arm_ids(app.wait_until_shown().pose.scene, camera.name)
    v, u = (float(places.mean()) for places in (ids >= 0).nonzero())
    for moved in (3.0, 9.0):
        app.queue.put(intents.DragLink(1.0, camera.name, (u, v), (u + moved, v)))
    app.queue.put(intents.SetReview(ReviewState.ACCEPTED))
    for layer in (Layer.MASK, Layer.CONTOUR, Layer.TRUTH, Layer.IMPORTED, Layer.PARTS, Layer.SHADED):
        app.queue.put(intents.ShowLayer(layer))
        app.wait_until_shown()
    for name in ("masks", "coco-keypoints", "bop", "video"):
        app.queue.put(intents.Export(name, "Accepted", masks="rendered"))
    app.wait_until_shown()
    app.queue.put(intents.Run())
    state = app.wait_until_shown()
    assert state.verdict is not None and state.run.curves.comparable
    app.queue.put(intents.SetReview(ReviewState.ACCEPTED))
    app.queue.put(intents.ShowLayer(Layer.REFINED))
    app.queue.put(intents.Export("masks", "Accepted", masks="refined"))
    state = app.wait_until_shown()
    steps = [step.name for step in state.project.steps]
    print(json.dumps([state.error, steps, [[job.state.value, job.text] for job in state.jobs]]))
"""


def test_the_page_needs_no_torch(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    arguments = [str(tiny_sequence()), str(tmp_path / "page.carts")]
    said = subprocess.check_output([sys.executable, "-c", _USE, *arguments], text=True, timeout=120)
    error, steps, jobs = json.loads(said.splitlines()[-1])
    assert error is None
    assert len(steps) == 5
    assert [state for state, _ in jobs] == ["done"] * 5
