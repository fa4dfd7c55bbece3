"""Commands that are stopped at any moment: nothing acknowledged is lost, and the same command comes to the same end."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import pytest

from carts_core.lab.training.loop import load_checkpoint
from carts_core.networks.weights import read_weights

POLITE = [signal.SIGTERM, signal.SIGHUP]
STOPS = 28
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
SMALL_RUN = [
    *("--architecture.widths", "4", "6", "8", "--architecture.encoder-convolutions", "1", "1", "1"),
    *("--architecture.decoder-convolutions", "1", "1"),
    *("--images.width", "64", "--images.height", "48", "--images.field-width", "80", "--images.things", "0"),
    *("--images.absent", "0"),
    *("--batch-size", "2", "--validation-samples", "2", "--workers", "0", "--threads", "1", "--steps", "400"),
    *("--checkpoint-every", "20", "--validation-every", "200"),
]


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=4, width=160, height=128)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder but hidden ones."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    named = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in named.items() if "/." not in f"/{name}"}


def check_results(folder: Path) -> int:
    """Check that all outputs of `carts optimize` in a folder are complete; returns the number of frames."""
    records = folder / "results.json"
    frames = json.loads(records.read_text())["frames"] if records.is_file() else {}
    for frame_id in frames:
        mask = cv2.imread(str(folder / "masks" / f"{frame_id}.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None and mask.shape == (128, 160)
    return len(frames)


Run = Callable[..., tuple[int, str]]
"""Function that runs a command and sends a signal after a delay or a change of a file; returns status and output."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    log = tmp_path_factory.mktemp("forked") / "log.txt"
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("forked.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )
    assert server.stdin is not None and server.stdout is not None
    stdin, stdout = server.stdin, server.stdout

    def run(
        arguments: list[str], seconds: float = 500.0, number: int = signal.SIGKILL, sign: Path | None = None
    ) -> tuple[int, str]:
        asked = {"seconds": seconds, "signal": number, "sign": sign and str(sign)}
        stdin.write(json.dumps({"arguments": arguments, "log": str(log), **asked}) + "\n")
        stdin.flush()
        return int(stdout.readline()), log.read_text().replace("\n", " ")

    yield run
    stdin.close()
    server.wait(60)


@pytest.mark.parametrize(
    ("mode", "number"), [pytest.param("frame", signal.SIGTERM, marks=pytest.mark.slow), ("sequence", signal.SIGHUP)]
)
def test_a_stopped_optimization_keeps_what_it_says_and_ends_as_if_it_had_not_been_stopped(
    sequence: Path, tmp_path: Path, mode: str, number: signal.Signals, run: Run
) -> None:
    command = ["optimize", str(sequence), "--mode", mode, "--settings", "iterations=4", "--output"]
    assert run([*command, str(tmp_path / "whole")])[0] == 0
    folder = tmp_path / "stopped" / "regular" / "left"
    sign = folder / ("results.json" if mode == "frame" else "checkpoint.txt")
    stopped = [*command, str(tmp_path / "stopped")]
    status, printed = run(stopped, number=number, sign=sign)
    assert status == 128 + number, printed
    assert f"stopped by {number.name}; " in printed and "rerun the command to resume" in printed
    said = re.search(r"(\d+) (?:frame|of \d+ frames)", printed)
    assert (said and mode == "sequence") or int(said[1]) == check_results(folder) >= 1  # pyright: ignore
    assert run(stopped, number=signal.SIGKILL, sign=sign)[0] == -signal.SIGKILL
    status, printed = run(stopped)
    assert status == 0 and ("already done" in printed if mode == "frame" else "resumed an earlier run" in printed), (
        printed
    )
    assert contents(tmp_path / "stopped") == contents(tmp_path / "whole")


@dataclass
class Campaign:
    """A command that is stopped again and again, at random moments, until it has been often enough."""

    name: str
    arguments: list[str]
    output: Path
    whole: dict[str, bytes] = field(default_factory=dict)
    stops: int = 0
    ends: int = 0


def campaigns(sequence: Path, folder: Path) -> dict[str, Campaign]:
    optimize = ["optimize", str(sequence), "--settings", "iterations=8", "--output"]
    few = ["--frames", "spread:2", "--settings", "iterations=2"]
    made = {
        "frame": [*optimize, str(folder / "frame")],
        "sequence": [*optimize, str(folder / "sequence"), "--mode", "sequence"],
        "calibrate": ["calibrate", str(sequence), "--output", str(folder / "calibrate"), *few],
        "export": ["export", str(sequence), str(folder / "export"), "--format", "masks"],
    }
    return {name: Campaign(name, arguments, folder / name) for name, arguments in made.items()}


def stop_often(run: Run, campaign: Campaign, times: int, randoms: random.Random) -> None:
    """Stop and start again until it was stopped that often; whenever it comes to its end, compare and start over."""
    began = time.monotonic()
    status, printed = run(campaign.arguments)
    length = time.monotonic() - began
    assert status == 0, printed
    campaign.whole = contents(campaign.output)
    acknowledged, overwrite = 0, ["--overwrite"] if campaign.name in ("calibrate", "export") else []
    for path in sorted(campaign.output.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    fresh = True
    while campaign.stops < times:
        number = randoms.choice([*POLITE, signal.SIGKILL])
        began = time.monotonic()
        status, printed = run([*campaign.arguments, *overwrite], randoms.uniform(0.0, length), number)
        if status == 0:
            if fresh:
                length = min(length, time.monotonic() - began)
            fresh = True
            assert contents(campaign.output) == campaign.whole, campaign.name
            campaign.ends += 1
            if not overwrite:
                for path in sorted(campaign.output.rglob("*"), reverse=True):
                    path.unlink() if path.is_file() else path.rmdir()
            acknowledged = 0
            continue
        campaign.stops, fresh = campaign.stops + 1, bool(overwrite)
        # Before `main` has set up its handlers a signal ends the process as it would any other.
        assert status in ((-number,) if number == signal.SIGKILL else (128 + number, -number)), printed
        if overwrite:
            assert contents(campaign.output) in ({}, campaign.whole), "neither nothing nor the whole"
            continue
        kept = check_results(campaign.output / "regular" / "left")
        assert kept >= acknowledged, "a frame that was there is gone"
        acknowledged = kept
        if said := re.search(r"left holds (\d+) frame", printed):
            assert int(said[1]) == kept, printed
    status, printed = run([*campaign.arguments, *overwrite])
    assert status == 0 and contents(campaign.output) == campaign.whole, printed
    campaign.ends += 1


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", ["frame", "sequence", "calibrate", "export"])
def test_commands_stopped_at_28_random_moments_come_to_the_same_bytes(
    name: str, sequence: Path, tmp_path: Path, run: Run
) -> None:
    campaign = campaigns(sequence, tmp_path / "out")[name]
    stop_often(run, campaign, STOPS, random.Random(name))
    print(f"{name}: {campaign.stops} stops, {campaign.ends} ends, the same bytes at each")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_training_stopped_at_28_random_moments_loses_no_step_that_it_said_it_has(tmp_path: Path, run: Run) -> None:
    randoms, output = random.Random(8), tmp_path / "run"
    step, said = 0, 0
    for _ in range(STOPS):
        number = randoms.choice([*POLITE, signal.SIGKILL])
        status, printed = run(["train", str(output), *SMALL_RUN], randoms.uniform(0.0, 12.0), number)
        assert status in (0, 128 + number, -number), printed
        checkpoint = load_checkpoint(output)
        now = checkpoint.step if checkpoint else 0
        assert now >= step
        if found := re.search(r"holds (\d+) step", printed):
            said += 1
            assert now == int(found[1]), printed
        step = now
    print(f"train: {STOPS} stops, {said} times it said what it holds, {step} steps at last")
    for weights in output.glob("*.safetensors"):
        if weights.name != "checkpoint.safetensors":
            read_weights(weights)
