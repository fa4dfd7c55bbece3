"""Display of objects in notebooks, as HTML: a picture with outlines, sentences and a table. All text is escaped."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

MAX_WIDTH = 720
"""Maximum width of a picture [px]; wider pictures are downscaled."""
_QUALITY = 88
"""JPEG quality."""

MEASURED_COLOUR, CORRECTED_COLOUR = (255, 170, 40), (80, 255, 120)
"""Outline colours of the measured and of the corrected arms, RGB."""

Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Picture:
    """RGB image with the outlines of masks."""

    image: UInt8[np.ndarray, "height width 3"]
    outlines: Sequence[tuple[Bool[np.ndarray, "height width"], Colour]] = ()
    """Masks and the colours of their outlines, RGB."""

    def drawn(self) -> UInt8[np.ndarray, "height width 3"]:
        """The image with the outlines, at full size."""
        picture = self.image.copy()
        for mask, colour in self.outlines:
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, contours, -1, colour, 1)
        return picture

    def reduced(self) -> "Picture":
        """Copy with a width of at most `MAX_WIDTH`. Outlines are drawn afterwards, so they stay one pixel wide."""
        height, width = self.image.shape[:2]
        if width <= MAX_WIDTH:
            return self
        size = MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))
        masks = [
            (cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool), colour)
            for mask, colour in self.outlines
        ]
        return Picture(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA), masks)

    def data_uri(self) -> str:
        """The drawn picture as a `data:` URI, downscaled if necessary."""
        drawn = cv2.cvtColor(self.reduced().drawn(), cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def display(title: str, picture: Picture | None, sentences: Sequence[str], rows: Sequence[Mapping[str, str]]) -> str:
    """HTML for the `_repr_html_` of an object.

    Args:
        title: heading.
        picture: picture above the sentences; may be None.
        sentences: paragraphs; empty ones are left out.
        rows: rows of the table; their keys are its headings.
    """
    # Imported here, because recordings are opened without reports.
    from .html import Table, render_page  # noqa: PLC0415

    return render_page(
        "notebook.html",
        title=title,
        picture=None if picture is None else picture.data_uri(),
        sentences=[sentence for sentence in sentences if sentence],
        table=Table.of("", "", rows),
    )
