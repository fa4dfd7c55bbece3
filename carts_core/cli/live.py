"""`carts live`: tracking of the arms in a stream."""

from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..console import Terminal
from ..errors import SettingsError
from ..settings.live import StreamAddress
from ..settings.ranges import Count, Range
from ..wording import counted
from .options import FrameFreeParameters, Network, RangedOptions, Selection, SequencePath, check_writable

if TYPE_CHECKING:
    from ..live import Tracked


@dataclass(frozen=True)
class Live(RangedOptions):
    """Track the arms in a stream of images and joints; late frames are dropped. Press Ctrl-C to stop."""

    sequence: SequencePath
    """Sequence file that defines arms and cameras and, for a replay, images and joints."""
    source: str = "replay"
    """Source of frames: `replay` (in real time), `camera:0`, `video:FILE`, `folder:PATH` (new files), or `socket:PORT`
    on 127.0.0.1 (docs/reference/live.md)."""
    joints_port: int | None = None
    """With `camera` and `video`: port on 127.0.0.1 for joints and results."""
    rate: Annotated[float | None, Range(0, 1000, above=True)] = None
    """Frame rate of a replay [1/s]; by default the frame rate of the recording."""
    loops: Count = 1
    """Number of repetitions of a replay."""
    output: Path | None = None
    """File for results, one JSON object per line; by default the standard output. With a socket, results are also sent
    to all clients.
    """
    quiet: bool = False
    """Do not print results on the standard output."""
    masks: bool = False
    """Include masks in the results."""
    overlay: tuple[Path, ...] = ()
    """Named pipes for outlines of the arms on green, one per camera, for a surgeon's console (docs/howto/live.md)."""
    record: Path | None = None
    """New folder in which the stream is recorded, as a sequence and a project with the corrections."""
    camera: tuple[str, ...] = Selection.camera
    """Cameras, by name."""
    domain: str | None = None
    """Domain of a replay, by name; by default the first domain of the sequence."""
    free: Annotated[FrameFreeParameters, tyro.conf.arg(name="")] = field(default_factory=FrameFreeParameters)
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)

    def __post_init__(self) -> None:
        StreamAddress.parse(self.source, self.joints_port)
        super().__post_init__()
        if self.output is not None:
            check_writable(self.output.parent)

    def run(self) -> None:
        """Track until the end of the stream or Ctrl-C."""
        from ..live import KeyedOverlay, LiveStatistics, LiveTracker, Recorder, Results, follow, open_stream
        from ..optimization import Backgrounds
        from ..project import Provenance
        from ..recording import Sequence

        console = Terminal(stderr=True)
        sequence = Sequence.open(self.sequence, progress=console.print)
        cameras = tuple(Selection(camera=self.camera).camera_names(sequence.scene))
        if self.overlay and len(self.overlay) != len(cameras):
            raise SettingsError(
                f"--overlay gives {counted(len(self.overlay), 'pipe')} for {counted(len(cameras), 'camera')}. Give one "
                "for each, in the order of --camera."
            )
        domain = Selection(domain=(self.domain,) if self.domain else ()).domain_names(sequence)[0]
        extractor = self.network.load()
        address = StreamAddress.parse(self.source, self.joints_port)
        known = Backgrounds.of(sequence, cameras, domain) if self.source == "replay" else None
        tracker = LiveTracker(
            sequence.scene, extractor, free=self.free, backgrounds=known, cameras=cameras, concurrent=True
        )
        results = Results(sequence.scene.with_cameras(cameras), masks=self.masks)
        with ExitStack() as held:
            stream = open_stream(address, sequence, cameras, domain, rate=self.rate, loops=self.loops)
            held.callback(stream.close)
            held.callback(tracker.close)
            if stream.server is not None:
                console.print(f"listening on 127.0.0.1:{stream.server.port}")
            lines, sinks, recorder = self._lines(), [], None
            if self.overlay:
                sinks.append(overlay := KeyedOverlay(sequence, dict(zip(cameras, self.overlay, strict=True))))
                held.callback(overlay.close)
            if self.record is not None:
                made_by = Provenance.made_by_optimizer({"live": True}, extractor.sha256)
                recorder = Recorder(sequence, cameras, self.record, made_by)

            def show(tracked: "Tracked") -> None:
                message = results.message(tracked)
                for send in (*lines, *stream.clients):
                    send(message)

            sinks = [show, *sinks, *([recorder] if recorder is not None else [])]
            statistics = LiveStatistics()
            try:
                # Ctrl-C is the normal way to stop; a closed output pipe also stops tracking.
                with suppress(KeyboardInterrupt, BrokenPipeError):
                    follow(stream.source, tracker, sinks, statistics)
            finally:
                console.print(str(statistics))
                if not statistics.tracked:
                    console.print(
                        "No frame was complete: a frame needs joints of every arm and an image of every camera."
                    )
                if recorder is not None and (path := recorder.close()) is not None:
                    console.print(f"wrote {path}. To inspect it: carts view {path}")
                    if recorder.shortfall:
                        console.print(recorder.shortfall)

    def _lines(self) -> "list[Callable]":
        """Functions that write results as lines of JSON."""
        import os
        import sys

        import msgspec

        from ..files import append_line, write_bytes

        encoder, output = msgspec.json.Encoder(), self.output
        if output is not None:
            write_bytes(output, b"")
            return [lambda message: append_line(output, encoder.encode(message), sync=False)]
        if self.quiet:
            return []

        def write(message: object) -> None:
            try:
                sys.stdout.buffer.write(encoder.encode(message) + b"\n")
                sys.stdout.buffer.flush()
            except BrokenPipeError:
                # Otherwise Python would flush the output again at exit, with an error.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise

        return [write]
