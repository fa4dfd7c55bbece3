"""What a measurement depends on, as a short text: a line of other settings, weights or code is not used again."""

import hashlib

from ... import fingerprints
from ...networks.extractor import FeatureExtractor
from ...settings.serialization import to_plain
from .frame import TOLERANCE
from .methods import METHODS
from .scope import Run, Scope

_MEASURED = (
    "*.py",
    "imaging/**/*.py",
    "model/**/*.py",
    "recording/*.py",
    "evaluation/**/*.py",
    "networks/**/*.py",
    "optimization/**/*.py",
    "rendering/**/*.py",
    "settings/calibration.py",
    "settings/network.py",
    "settings/optimization.py",
    "settings/presets.py",
    "settings/sequence.py",
    "settings/stages.py",
    "lab/baselines/networks.py",
    "lab/benchmark/baseline.py",
    "lab/benchmark/frame.py",
    "lab/benchmark/occlusion.py",
    "lab/benchmark/temporal.py",
    "lab/benchmark/together.py",
    "lab/benchmark/wrong_inputs.py",
)


def code_fingerprint(patterns: tuple[str, ...] = _MEASURED) -> str:
    """SHA-256 over modules of the package; by default those that decide what a method returns, and how it is scored."""
    return fingerprints.code_fingerprint(patterns)


def run_fingerprint(
    run: Run, scope: Scope, extractor: FeatureExtractor, source: str, baseline: str | None = None
) -> str:
    """SHA-256 over everything that a run's result depends on, but the machine.

    Args:
        run: the run.
        scope: with the number of steps in the paper's setting.
        extractor: the network and its device.
        source: fingerprint of the images and kinematics.
        baseline: of the weights of a baseline, where the run is one's.
    """
    method = METHODS[run.method]
    settings = to_plain(method.settings(scope.steps(run))) if method.settings else {}
    company = scope.calibration_frames if method.calibrated else scope.consecutive if method.together else 1
    parts = (settings, company, extractor.fingerprint, str(extractor.device), source, TOLERANCE, code_fingerprint())
    parts += (baseline,) if baseline is not None else ()
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]
