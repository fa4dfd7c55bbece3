"""Image files: whole ones are decoded as they are, damaged ones are errors."""

import cv2
import numpy as np
import pytest

from carts_core.errors import SequenceError
from carts_core.recording.images import read_image, read_mask

RNG = np.random.default_rng(3)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (90, 120, 3), dtype=np.uint8), (9, 9), 0)


@pytest.fixture(params=[".jpg", ".png"])
def image_file(request, tmp_path):
    path = tmp_path / f"picture{request.param}"
    assert cv2.imwrite(str(path), PICTURE[..., ::-1])
    return path


@pytest.mark.parametrize("share", [0.001, 0.2, 0.5, 0.9, 0.999])
def test_a_truncated_image_is_an_error_however_little_is_missing(image_file, share):
    content = image_file.read_bytes()
    image_file.write_bytes(content[: max(1, int(len(content) * share))])
    with pytest.raises(SequenceError, match=rf"image {image_file} .*Copy or export it again"):
        read_image(image_file)


def test_a_flipped_byte_in_a_png_is_an_error(tmp_path):
    path = tmp_path / "flipped.png"
    cv2.imwrite(str(path), PICTURE)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(SequenceError, match="the checksum of its IDAT chunk is wrong"):
        read_image(path)


@pytest.mark.parametrize(("content", "message"), [(b"", "the file is empty"), (b"hello" * 50, "cannot be decoded")])
def test_a_file_that_is_no_image_is_an_error(tmp_path, content, message):
    path = tmp_path / "picture.jpg"
    path.write_bytes(content)
    with pytest.raises(SequenceError, match=message):
        read_image(path)


def test_a_mask_is_what_is_at_least_half_bright(tmp_path):
    values = np.array([[0, 127, 128, 255]], np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), values)
    assert read_mask(tmp_path / "mask.png").tolist() == [[False, False, True, True]]


@pytest.mark.parametrize("brightest", [1, 255])
def test_a_deep_mask_is_as_white_as_its_pixels_can_be(tmp_path, brightest: int):
    values = np.array([[0, 32767, 32768, 65535]], np.uint16)
    cv2.imwrite(str(tmp_path / "mask.png"), values)
    assert read_mask(tmp_path / "mask.png").tolist() == [[False, False, True, True]]
    cv2.imwrite(str(tmp_path / "mask.png"), np.eye(4, dtype=np.uint16) * brightest)
    with pytest.raises(SequenceError, match=rf"no value above {brightest}\. .* and 65535"):
        read_mask(tmp_path / "mask.png")


def test_a_mask_of_zeros_and_ones_is_noticed(tmp_path):
    cv2.imwrite(str(tmp_path / "mask.png"), np.eye(4, dtype=np.uint8))
    with pytest.raises(SequenceError, match=r"mask .*mask.png has no value above 1. .*Multiply"):
        read_mask(tmp_path / "mask.png")
