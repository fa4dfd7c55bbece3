"""Video files for tests."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
from av.video.stream import VideoStream

_MILLISECOND = Fraction(1, 1000)
_AVI_RATE = 25


def write_timed_video(
    path: Path,
    images: Iterable[np.ndarray],
    milliseconds: Iterable[int],
    codec: str = "libx264",
    options: dict[str, str] | None = None,
) -> Path:
    """A video whose image n is shown from `milliseconds[n]` on; AVI, which has no such times, shows 25 a second.

    A name that begins with "transport" makes an MPEG transport stream, whatever its suffix is.
    """
    avi = path.suffix == ".avi"
    with av.open(str(path), "w", format="mpegts" if path.name.startswith("transport") else None) as container:
        stream = cast(VideoStream, container.add_stream(codec, rate=_AVI_RATE if avi else 1000, options=options))
        stream.pix_fmt = "yuv420p"
        for number, (image, time) in enumerate(zip(images, milliseconds, strict=True)):
            if number == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = (number, Fraction(1, _AVI_RATE)) if avi else (int(time), _MILLISECOND)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
