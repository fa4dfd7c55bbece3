"""Hand-eye calibrations of the benchmark: measured once, kept, and counted."""

from pathlib import Path

import pytest

from carts_core.files import output_path
from carts_core.lab.benchmark import hand_eye
from carts_core.lab.benchmark.hand_eye import CONDITIONS, HandEyeRun, known_hand_eye, measure_hand_eye
from carts_core.networks.extractor import FeatureExtractor


def test_one_start_is_measured_kept_and_not_measured_again(
    tmp_path: Path, extractor: FeatureExtractor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand_eye, "CONDITIONS", CONDITIONS[:1])
    run = HandEyeRun(CONDITIONS[0].name, 0, 0.1, 1e-3, "good")
    monkeypatch.setattr(hand_eye, "_run", lambda condition, seed, extractor: run)
    file, said = output_path(tmp_path, "hand_eye.json"), list[str]()
    assert measure_hand_eye(file, extractor, 1, said.append) == [run]
    assert len(said) == 1 and known_hand_eye(file, extractor) == [run]
    assert measure_hand_eye(file, extractor, 1, said.append) == [run] and len(said) == 1
    file.path.write_text(file.path.read_text().replace(extractor.fingerprint, "other weights"))
    assert known_hand_eye(file, extractor) == []
