"""Benchmark of the page with large recordings: one hour at 30 frames/s with two cameras, and sliders with four cameras.

    python -m tools.bench_page [--frames 108000] [--moves 200]

The recordings are generated in a temporary folder, from the images and the arms of the shipped sequence. Times are
measured from the request of a tab to the arrival of frame and overlay, which are sent together, for cached frames
(shown shortly before) and for jumps to random frames.
"""

import argparse
import csv
import gc
import io
import os
import random
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np

from carts_core.files import output_path, output_stream, write_text
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence
from carts_viewer.app import ViewerApp
from tools.bench_viewer import slider_latency
from tools.memory import resident_megabytes
from tools.raw_tab import RawTab

RATE = 30
"""Frame rate [frames/s]."""
_HOLD = 10
"""Number of consecutive frames with the same image of the shipped sequence."""
_APART = 0.004
"""Distance between neighbouring cameras [m]."""
_SWAY = 0.003
"""Amplitude of the motion of each joint [rad, m]."""
_LONGEST = 20.0
"""Timeout for a picture [s]."""


@dataclass(frozen=True)
class Hour:
    """Measurements on the long recording."""

    open_seconds: float
    """Time from opening the sequence file to the first overlay in a tab [s]."""
    open_processor: float
    """Processor time until the first overlay [s]."""
    cached: list[float]
    """Time from the selection of a frame to its arrival [ms]."""
    jumps: list[float]
    dragged: list[float]
    """Intervals between pictures during a drag over the whole timeline with 30 positions per second [ms]."""
    megabytes: list[float]
    """Memory after opening, and after each of the measurements above."""


def make_recording(folder: Path, frames: int, cameras: int) -> Path:
    """Write a recording of the shipped arms with a video per camera; returns its sequence file."""
    sample = Sequence.open(sample_sequence())
    output = output_path(folder, draft=True)
    pictures = [sample.frame(index).images[sample.scene.cameras[0].name] for index in range(len(sample))]
    names = [f"camera{number}" for number in range(cameras)]
    for name in names:
        with output_stream(output / f"{name}.mp4") as file:
            _write_video(file, pictures, frames)
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    joints = {arm.name: arm.robot.joint_names for arm in sample.scene.arms}
    writer.writerow(["frame", "time", *(f"{arm}.{joint}" for arm, own in joints.items() for joint in own)])
    rows = [np.concatenate([sample.measured[arm][row] for arm in joints]) for row in range(len(sample))]
    for frame in range(frames):
        # No two frames are alike, or there would be nothing to send.
        positions = rows[frame // _HOLD % len(rows)] + _SWAY * np.sin(0.37 * frame)
        writer.writerow([f"{frame:06d}", f"{frame / RATE:.4f}", *(f"{value:.5f}" for value in positions)])
    write_text(output / "kinematics.csv", table.getvalue())
    write_text(output / "sequence.toml", _sequence_file(sample, names))
    return folder / "sequence.toml"


def _write_video(file: BinaryIO, pictures: list[np.ndarray], frames: int) -> None:
    """Encode the images once, and write the packets repeatedly."""
    with av.open(file, "w", format="mp4") as container:
        options = {"preset": "ultrafast", "crf": "33", "bf": "0", "g": "60", "sc_threshold": "0"}
        stream = container.add_stream("libx264", rate=RATE, options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        images = [av.VideoFrame.from_ndarray(picture, format="rgb24") for picture in pictures for _ in range(_HOLD)]
        for number, image in enumerate(images):
            image.pts = number
        packets = [packet for image in [*images, None] for packet in stream.encode(image)]
        if len(packets) != len(images) or any(packet.pts is None or packet.dts is None for packet in packets):
            raise RuntimeError("The encoder did not give one packet for each picture.")
        step = (packets[1].pts or 0) - (packets[0].pts or 0)
        contents = [(bytes(packet), packet.is_keyframe, packet.time_base) for packet in packets]
        for frame in range(frames):
            content, is_keyframe, time_base = contents[frame % len(contents)]
            packet = av.Packet(content)
            packet.stream, packet.time_base, packet.is_keyframe = stream, time_base, is_keyframe
            packet.pts = packet.dts = frame * step
            packet.duration = step
            container.mux(packet)


def _sequence_file(sample: Sequence, names: list[str]) -> str:
    """The arms of the shipped sequence in front of cameras in a row."""
    arms = sample.path.read_text(encoding="utf-8").partition("[[arms]]")
    camera = sample.scene.cameras[0]
    lines = ['format = "carts-sequence/1"', 'name = "hour"', "[kinematics]", 'table = "kinematics.csv"']
    lines += ['frame = "frame"', 'timestamp = "time"']
    for number, name in enumerate(names):
        T = np.asarray(camera.T_camera_world, float).copy()
        T[0, 3] -= number * _APART
        lines += ["[[cameras]]", f'name = "{name}"', f"size = [{camera.width}, {camera.height}]"]
        lines += [f"K = {np.asarray(camera.K).tolist()}", f"T_camera_world = {T.tolist()}", f'images = "{name}.mp4"']
    return "\n".join([*lines, arms[1] + arms[2]])


def measure_hour(path: Path, moves: int) -> Hour:
    """Open a recording, show cached frames, jump to random frames, and drag over the timeline."""
    began, worked = time.perf_counter(), time.process_time()
    with (
        tempfile.TemporaryDirectory() as folder,
        ViewerApp.open(path, project=Path(folder) / "bench.carts", port=0) as app,
        RawTab(app.url, keep=4, key="bench") as tab,
    ):
        _wait(lambda: len(tab.overlays) > 0)
        opened, worked = time.perf_counter() - began, time.process_time() - worked
        app.wait_until_shown(120)
        memory = [resident_megabytes()]
        frame = app.page.element_id(app.view.page.find("Frame"))
        dice, frames = random.Random(0), len(app.sequence)
        near = [frames // 2 + 7 * number for number in range(12)]
        _go(app, tab, frame, near)
        cached = _go(app, tab, frame, [near[number * 5 % len(near)] for number in range(moves)])
        memory.append(resident_megabytes())
        jumps: list[float] = []
        for _ in range(5):
            jumps += _go(app, tab, frame, [dice.randrange(frames) for _ in range(moves // 5)])
            memory.append(resident_megabytes())
        dragged = _drag(app, tab, frame, frames)
        memory.append(resident_megabytes())
    return Hour(opened, worked, cached, jumps, dragged, memory)


def _go(app: ViewerApp, tab: RawTab, element: str, frames: Iterable[int]) -> list[float]:
    """Show frames one after the other; returns the time of each [ms]."""
    times = []
    for frame in frames:
        if frame == app.state.index:
            continue
        before, began = tab.overlays[-1][0], time.perf_counter()
        tab.set(element, frame + 1)
        _wait(lambda before=before: tab.overlays[-1][0] > before)
        times.append(1e3 * (tab.overlays[-1][0] - began))
        app.wait_until_shown(60)
        if app.state.index != frame or app.state.error is not None:
            raise RuntimeError(f"Frame {frame} was asked for, {app.state.index} is shown: {app.state.error}")
        time.sleep(0.05)
    return times


def _drag(app: ViewerApp, tab: RawTab, element: str, frames: int, seconds: float = 10.0) -> list[float]:
    """Drag over the whole timeline; returns the intervals between pictures [ms]."""
    arrivals: list[float] = []
    for step in range(int(30 * seconds)):
        tab.set(element, 1 + round((frames - 1) * step / (30 * seconds)))
        time.sleep(1 / 30)
        if not arrivals or tab.overlays[-1][0] != arrivals[-1]:
            arrivals.append(tab.overlays[-1][0])
    app.wait_until_shown(60)
    return [1e3 * (later - earlier) for earlier, later in pairwise(arrivals[1:])]


def _wait(condition) -> None:
    end = time.monotonic() + _LONGEST
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"No picture came within {_LONGEST:g} s.")
        time.sleep(0.0005)


def _figures(times: list[float]) -> str:
    return (
        f"median {np.median(times):.0f}, p95 {np.percentile(times, 95):.0f}, worst {max(times):.0f} ms ({len(times)})"
    )


def _made(folder: Path, frames: int, cameras: int) -> Path:
    """Recording generated in another process, whose memory is not measured."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(make_recording, folder, frames, cameras).result()


def main() -> None:
    """Print the measurements, with the load of the machine before and after."""
    tune_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=3600 * RATE)
    parser.add_argument("--moves", type=int, default=200)
    arguments = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        path = _made(Path(folder), arguments.frames, 2)
        for run in range(2):
            hour = measure_hour(path, arguments.moves)
            print(f"run {run + 1}: {arguments.frames} frames, two cameras, opened in {hour.open_seconds:.1f} s", end="")
            print(f" ({hour.open_processor:.1f} s of processor time)")
            print(f"  scrub, cached: {_figures(hour.cached)}; not cached: {_figures(hour.jumps)}")
            print(f"  pictures while dragging over all: {_figures(hour.dragged)}")
            print(f"  memory: {', '.join(f'{megabytes:.0f}' for megabytes in hour.megabytes)} MB", flush=True)
            gc.collect()
    with tempfile.TemporaryDirectory() as folder:
        path = _made(Path(folder), 30, 4)
        with ViewerApp.open(path, project=Path(folder) / "bench.carts", port=0) as app:
            app.wait_until_shown(120)
            latency = slider_latency(app)
            print(f"four cameras, slider to overlays: median {latency.median:.0f}, p95 {latency.p95:.0f} ms", end="")
            print(f", worst {latency.worst:.0f} ms; stale at the end: {latency.stale}")
    print(f"load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
