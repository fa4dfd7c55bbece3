"""The results file: one JSON line per run, appended as soon as it is known."""

import json

from ...errors import CartsError
from ...files import OutputPath, append_line
from ...files.reading import TABLE, read_bytes
from .measurement import Measurement
from .scope import Run


class ResultsFile:
    """Measurements on disk. A run that is killed loses at most the line that it was writing.

    Args:
        path: the file; it need not exist.

    Raises:
        CartsError: the file cannot be read.
    """

    def __init__(self, path: OutputPath) -> None:
        self.path = path
        self._known: dict[tuple[Run, str], Measurement] = {}
        self.unreadable = 0
        """Lines that are not measurements: torn, or of another version."""
        try:
            lines = read_bytes(path.path, TABLE).splitlines() if path.path.exists() else []
        except OSError as error:
            raise CartsError(
                f"{path} cannot be read ({error.strerror or error}). Name another output folder."
            ) from error
        for line in lines:
            try:
                entry = json.loads(line)
                measurement = Measurement.from_json(entry)
                self._known[measurement.run, entry["fingerprint"]] = measurement
            except (KeyError, TypeError, ValueError):
                self.unreadable += 1

    def find(self, run: Run, fingerprint: str) -> Measurement | None:
        """The measurement of a run under exactly these settings, weights and code; None if it is not there."""
        return self._known.get((run, fingerprint))

    def append(self, measurement: Measurement, fingerprint: str, **also: str) -> None:
        """Add a measurement and see it on disk.

        Args:
            measurement: what was measured.
            fingerprint: of all that it depends on; see `fingerprints`.
            also: further facts for the line, for whoever reads the file.

        Raises:
            OutputError: the file cannot be written.
        """
        entry = measurement.to_json()
        line = json.dumps({"fingerprint": fingerprint, **also, **entry}, separators=(",", ":"))
        append_line(self.path, line.encode())
        # As it will be read again, so that a report does not depend on when it is written.
        self._known[measurement.run, fingerprint] = Measurement.from_json(entry)
