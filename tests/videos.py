"""Video files for tests."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
from av.video.stream import VideoStream

_MIRRORED = [-65536, 0, 0, 0, 65536, 0, 0, 0, 2**30]


def write_video(
    path: Path,
    images: Iterable[np.ndarray],
    rate: int = 25,
    codec: str = "libx264",
    *,
    milliseconds: Iterable[int] | None = None,
    pixels: str = "yuv420p",
    options: dict[str, str] | None = None,
    rotation: int = 0,
    mirrored: bool = False,
) -> Path:
    """A video of RGB images, with a display matrix on request.

    Image n is shown from `milliseconds[n]` on, or from n / rate; AVI has no such times. A name that begins with
    "transport" makes an MPEG transport stream, whatever its suffix is.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    times = None if milliseconds is None or path.suffix == ".avi" else iter(milliseconds)
    with av.open(str(path), "w", format="mpegts" if path.name.startswith("transport") else None) as container:
        stream = cast(VideoStream, container.add_stream(codec, rate=1000 if times else rate, options=options))
        stream.pix_fmt = pixels
        if rotation:
            stream.set_display_rotation(rotation)
        if mirrored:
            stream.set_display_matrix(_MIRRORED)
        for number, image in enumerate(images):
            if number == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = (int(next(times)), Fraction(1, 1000)) if times else (number, Fraction(1, rate))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
