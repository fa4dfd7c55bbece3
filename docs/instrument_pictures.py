"""Draw the sheet of built-in instruments for the reference.

python docs/instrument_pictures.py
"""

from pathlib import Path

import cv2
import numpy as np

from carts_core.model.instruments import INSTRUMENTS, SCHEME
from carts_core.model.robot import Robot
from carts_core.rendering.portrait import portrait

SHEET = Path(__file__).parent / "images" / "instruments.jpg"
COLUMNS, WIDTH, HEIGHT, CAPTION = 4, 300, 150, 24
QUALITY = 85


def main() -> None:
    """Write the sheet, in the order in which `carts robots` lists the instruments."""
    tiles = []
    for instrument in INSTRUMENTS:
        picture = portrait(Robot.load(SCHEME + instrument.name), WIDTH, HEIGHT)
        caption = np.full((CAPTION, WIDTH, 3), 255, np.uint8)
        place = (8, CAPTION - 7)
        cv2.putText(caption, instrument.name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
        tiles.append(np.vstack([picture, caption]))
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[first : first + COLUMNS]) for first in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(SHEET), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
