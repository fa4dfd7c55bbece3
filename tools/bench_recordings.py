"""`python -m tools.bench_recordings`: times of opening and browsing a recording of 10,000 frames on this machine.

The recording is generated in a temporary folder: image files, an MP4 of the same images with B-frames, and a log of
joint positions at 200 Hz that is matched with the video's presentation times.
"""

import argparse
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from rich.table import Table

from carts_core.console import Terminal
from carts_core.files import OutputPath, output_path, output_stream, write_bytes, write_text
from carts_core.process import tune_process
from carts_core.recording import FrameReader, Sequence
from tools.memory import resident_megabytes

WIDTH, HEIGHT = 640, 480
RATE = 25
"""Frame rate of the video [frames/s]."""
LOG_RATE = 200
"""Rate of the log [rows/s]."""
_PICTURES = 100
_JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")


def make_recording(folder: Path, frames: int) -> dict[str, Path]:
    """Write the same recording as image files and as a video; returns the sequence file of each."""
    pictures = list(_pictures())
    output = output_path(folder, draft=True)
    encoded = [cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes() for picture in pictures]
    for frame in range(frames):
        write_bytes(output / "left" / f"{frame:06d}.jpg", encoded[frame % _PICTURES])
    with output_stream(output / "left.mp4") as file, av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"preset": "veryfast", "bf": "3", "g": "50"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pictures[frame % _PICTURES], format="rgb24")))
        container.mux(stream.encode(None))
    _write_table(output / "rows.csv", "frame", (f"{frame:06d}" for frame in range(frames)))
    seconds = np.arange(0.0, frames / RATE, 1.0 / LOG_RATE)
    _write_table(output / "log.csv", "time", map(str, seconds.tolist()))
    files = {
        "image files": _sequence('[kinematics]\ntable = "rows.csv"', "left/{frame}.jpg"),
        "MP4, rows by time": _sequence(
            '[frames]\nvideo = "left.mp4"\n[kinematics]\ntable = "log.csv"\ntimestamp = "time"', "left.mp4"
        ),
    }
    paths = {name: output / f"{number}.toml" for number, name in enumerate(files)}
    for name, path in paths.items():
        write_text(path, files[name])
    return {name: path.path for name, path in paths.items()}


def open_seconds(path: Path, runs: int) -> list[float]:
    """Durations of opening a sequence up to its first image [s]."""
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        Sequence.open(path).frame(0)
        times.append(time.perf_counter() - began)
    return times


def browse(sequence: Sequence, indices: Iterable[int]) -> tuple[list[float], list[float]]:
    """Show frames one after the other; returns the time of each [ms], and memory at five times [MB]."""
    reader, camera = FrameReader(sequence), sequence.scene.cameras[0].name
    order = list(indices)
    times, memory = [], []
    for number, index in enumerate(order, start=1):
        began = time.perf_counter()
        reader.frame(index, sequence.domains[0], camera)
        times.append(1e3 * (time.perf_counter() - began))
        # The page draws it; without a pause there would be nothing to read in advance.
        time.sleep(0.01)
        if number % max(len(order) // 5, 1) == 0:
            memory.append(resident_megabytes())
    reader.close()
    return times, memory


def _pictures() -> Iterator[np.ndarray]:
    """Smooth moving images with noise, whose file size is similar to that of tissue images."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH + _PICTURES, 3)).astype(np.float32), (0, 0), 6)
    texture = (texture - texture.min()) / (texture.max() - texture.min()) * 255
    for shift in range(_PICTURES):
        noisy = texture[:, shift : shift + WIDTH] + rng.normal(0, 3, (HEIGHT, WIDTH, 3))
        yield np.ascontiguousarray(noisy.clip(0, 255).astype(np.uint8))


def _write_table(path: OutputPath, column: str, cells: Iterable[str]) -> None:
    positions = ",".join("0.150000" if joint == "insertion" else "0.100000" for joint in _JOINTS)
    rows = [f"{column},{','.join(_JOINTS)}", *(f"{cell},{positions}" for cell in cells)]
    write_text(path, "\n".join(rows) + "\n")


def _sequence(tables: str, images: str) -> str:
    joints = "\n".join(f'{joint} = "{joint}"' for joint in _JOINTS)
    return f"""
format = "carts-sequence/1"
{tables}
[[arms]]
name = "PSM1"
robot = "builtin:psm_lnd"
[arms.joints]
{joints}
[[cameras]]
name = "left"
size = [{WIDTH}, {HEIGHT}]
K = {{ fx = 780.0, fy = 780.0, cx = 320.0, cy = 240.0 }}
images = "{images}"
"""


def main() -> None:
    """Print the table."""
    tune_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--runs", type=int, default=5, help="how often each is opened")
    arguments = parser.parse_args()
    frames = arguments.frames
    rng = np.random.default_rng(0)
    walks = {
        "forwards": range(min(1000, frames)),
        "backwards": range(frames - 1, max(frames - 1001, -1), -1),
        "jumps": rng.integers(0, frames, 500).tolist(),
    }
    table = Table(title=f"{frames} frames, {WIDTH}x{HEIGHT}")
    for name in ("source", "what", "median", "p95", "worst", "memory at each fifth [MB]"):
        table.add_column(name, justify="left" if name in ("source", "what") else "right")

    def add_row(source: str, what: str, unit: str, times: list[float], memory: Iterable[float] = ()) -> None:
        figures = (np.median(times), np.percentile(times, 95), max(times))
        table.add_row(source, what, *(f"{x:.2f} {unit}" for x in figures), " ".join(f"{x:.0f}" for x in memory))

    with tempfile.TemporaryDirectory() as folder:
        Terminal().print(f"Writing {frames} images and a video into {folder} ...")
        for source, path in make_recording(Path(folder), frames).items():
            add_row(source, "open, with the first image", "s", open_seconds(path, arguments.runs))
            sequence = Sequence.open(path)
            for what, indices in walks.items():
                times, memory = browse(sequence, indices)
                add_row(source, f"frame change, {what}", "ms", times, memory)
            del sequence  # Its cache would count as the next one's.
    Terminal().print(table)


if __name__ == "__main__":
    main()
