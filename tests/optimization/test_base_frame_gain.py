"""Whether base frames are suspected, with the shipped networks: where they are right, and on real frames."""

from pathlib import Path

import pytest

from carts_core.evaluation import start_positions
from carts_core.networks import FeatureExtractor
from carts_core.optimization import BASE_FRAME_GAIN, FrameOptimizer, SequenceOptimizer
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence

REAL = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"


def gain(sequence: Sequence, index: int, domain: str, camera: str, perturb_deg: float) -> float:
    frame = sequence.frame(index, domain, [camera])
    start = start_positions(sequence, frame, perturb_deg, 0)
    extractor = FeatureExtractor.load()
    optimizer = FrameOptimizer(sequence.scene, frame, {}, extractor, start=start, cameras=[camera], live=False)
    list(optimizer)
    found = optimizer.base_frame_gain()
    assert found is not None
    return found


@pytest.mark.parametrize("domain", ["regular", "smoke"])
def test_base_frames_that_are_right_are_not_suspected(domain: str) -> None:
    sequence = Sequence.open(sample_sequence())
    assert gain(sequence, 5, domain, sequence.scene.cameras[0].name, 2.0) < BASE_FRAME_GAIN


@pytest.mark.slow
@pytest.mark.usefixtures("shared_dir")
def test_a_sequence_tells_which_camera_contradicts_its_base_frame() -> None:
    sequence, extractor = Sequence.open(REAL), FeatureExtractor.load()
    gains = {}
    for camera in ("left", "right"):
        optimizer = SequenceOptimizer(
            sequence.scene,
            lambda index, camera=camera: sequence.frame(index, "regular", [camera]),
            dict.fromkeys(range(3)),
            extractor,
            cameras=[camera],
        )
        assert optimizer.base_frame_gain() is None, "nothing is known before the end"
        list(optimizer)
        gains[camera] = optimizer.base_frame_gain()
    assert gains["left"] < BASE_FRAME_GAIN < gains["right"]
