"""Images, masks and videos of laboratories: read with the right pixels, or refused."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from videos import write_video

from carts_core.errors import SequenceError
from carts_core.recording import Sequence
from carts_core.recording.annotations import read_annotations
from carts_core.recording.images import read_image, read_mask
from carts_core.recording.importing.cameras import find_images
from carts_core.recording.video import Video

HEIGHT, WIDTH = 72, 96
RNG = np.random.default_rng(5)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 4)
DISC = (np.mgrid[:HEIGHT, :WIDTH][0] - 30) ** 2 + (np.mgrid[:HEIGHT, :WIDTH][1] - 40) ** 2 < 15**2
WHITE = np.uint8(255) * DISC


def png(values: np.ndarray) -> bytes:
    stored = values
    if values.ndim == 3:
        stored = np.concatenate([values[..., 2::-1], values[..., 3:]], -1)
    return cv2.imencode(".png", stored)[1].tobytes()


def pillow(values: np.ndarray, kind: str, mode: str | None = None, **options: Any) -> bytes:
    stream = io.BytesIO()
    image = Image.fromarray(values)
    (image if mode is None else image.convert(mode)).save(stream, kind, **options)
    return stream.getvalue()


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


def palette(indices: np.ndarray, colours: list[int]) -> bytes:
    image = Image.fromarray(indices)
    image = image.convert("P") if image.mode != "P" else image
    image.putdata(indices.reshape(-1).tolist())
    image.putpalette(colours)
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize("orientation", [3, 5, 6, 7, 8])
def test_images_are_turned_as_their_orientation_says(tmp_path: Path, kind: str, orientation: int) -> None:
    path = tmp_path / f"image_1.{kind.lower()}"
    path.write_bytes(pillow(PICTURE, kind, exif=exif(orientation)))
    wanted = np.array(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    assert np.abs(read_image(path).astype(int) - wanted).max() <= 3
    found = find_images(tmp_path)
    assert found.size == (wanted.shape[1], wanted.shape[0])
    assert any(f"EXIF orientation {orientation}" in text for text in found.remarks)


def test_masks_are_turned_as_images_are(tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    path.write_bytes(pillow(WHITE, "PNG", exif=exif(6)))
    assert np.array_equal(read_mask(path), np.rot90(DISC, -1))


@pytest.mark.parametrize(("bits", "stored"), [(12, 12), (10, 10), (14, 14), (16, 16)])
def test_bits_in_use_are_counted_in_all_images_of_a_camera(tmp_path: Path, bits: int, stored: int) -> None:
    deep = (PICTURE.astype(np.uint16) << (bits - 8)) | 1
    deep[0, 0] = 2**bits - 1
    (tmp_path / "1.png").write_bytes(png(deep // 8))
    (tmp_path / "2.png").write_bytes(png(deep))
    found = find_images(tmp_path)
    assert found.bits == stored
    assert any(f"{stored} of 16 bits are used" in text for text in found.remarks)
    difference = np.abs(read_image(tmp_path / "2.png").astype(int) - PICTURE)
    assert difference[1:].max() <= 1


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("rgba.png", png(np.dstack([PICTURE, np.full((HEIGHT, WIDTH), 255, np.uint8)]))),
        ("half_transparent.png", png(np.dstack([PICTURE, np.full((HEIGHT, WIDTH), 90, np.uint8)]))),
        ("progressive.jpg", pillow(PICTURE, "JPEG", progressive=True, quality=95)),
        ("cmyk.jpg", pillow(PICTURE, "JPEG", "CMYK", quality=98)),
        ("image.tiff", pillow(PICTURE, "TIFF")),
        ("lzw.tif", pillow(PICTURE, "TIFF", compression="tiff_lzw")),
        ("image.webp", pillow(PICTURE, "WEBP", lossless=True)),
        ("image.bmp", pillow(PICTURE, "BMP")),
    ],
)
def test_an_image_of_any_kind_has_the_same_colours(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    assert np.abs(read_image(tmp_path / name).astype(int) - PICTURE).mean() < 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pillow(np.linspace(0, 1, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH), "TIFF"), "8 or 16 bits"),
        (png(PICTURE)[:-2000], "damaged"),
    ],
)
def test_an_image_that_cannot_be_right_is_an_error(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "image.png").write_bytes(content)
    with pytest.raises(SequenceError, match=message):
        read_image(tmp_path / "image.png")


RED = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
RED[DISC] = 255, 20, 20
CUT_OUT = np.dstack([PICTURE, WHITE])
BLURRED = cv2.GaussianBlur(WHITE, (0, 0), 1.2)


@pytest.mark.parametrize(
    ("name", "content", "remark"),
    [
        ("white.png", png(WHITE), ""),
        ("borders.png", png(BLURRED), "grey borders"),
        ("cut_out.png", png(np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), WHITE])), "alpha channel"),
        ("photograph.png", png(CUT_OUT), "alpha channel"),
        ("deep.png", png(WHITE.astype(np.uint16) * 257), ""),
        ("compressed.jpg", pillow(WHITE, "JPEG", quality=80), "grey borders"),
        ("one_bit.png", pillow(WHITE, "PNG", "1"), ""),
        ("white_palette.png", palette(DISC.astype(np.uint8), [0, 0, 0, 255, 255, 255]), ""),
        ("red.png", png(RED), ""),
    ],
)
def test_a_mask_of_any_kind_is_the_same_mask(
    tiny_sequence: Callable[..., Path], tmp_path: Path, name: str, content: bytes, remark: str
) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    path = place / f"001{Path(name).suffix}"
    path.write_bytes(content)
    assert (read_mask(path) ^ DISC).mean() < 0.005
    if name == "red.png":
        return
    found = read_annotations(tmp_path / "others", Sequence.open(tiny_sequence(masks=False)))
    (frame,) = found.frames
    assert frame.labels is not None and ((frame.labels > 0) ^ DISC).mean() < 0.005
    assert found.label_names == ["instrument"]
    assert any(remark in text for text in found.remarks) if remark else not found.remarks


LABELS = np.where(DISC, 7, 0)
LABELS[50:70, 70:90] = 1


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (png(LABELS.astype(np.uint16)), ["label 1", "label 7"]),
        (png(LABELS.astype(np.uint8)), ["label 1", "label 7"]),
        (palette(LABELS.astype(np.uint8), [0, 0, 0, 128, 0, 0, *[0] * 15, 64, 128, 0]), ["label 1", "label 7"]),
        (png(np.where(LABELS == 7, 255, LABELS).astype(np.uint8)), ["label 1", "label 255"]),
        (palette(LABELS.astype(np.uint8), [0, 0, 0, 60, 60, 60, *[9] * 15, 200, 200, 200]), ["label 1", "label 7"]),
    ],
)
def test_labels_keep_their_values_and_are_no_mask(
    tiny_sequence: Callable[..., Path], tmp_path: Path, content: bytes, names: list[str]
) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    (place / "001.png").write_bytes(content)
    found = read_annotations(tmp_path / "others", Sequence.open(tiny_sequence(masks=False)))
    (frame,) = found.frames
    assert found.label_names == names and frame.labels is not None
    assert np.array_equal(frame.labels, np.where(LABELS == 7, 2, LABELS))
    with pytest.raises(SequenceError, match="Masks are 0"):
        read_mask(place / "001.png")


def test_the_colours_of_a_palette_do_not_merge_labels(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    white = [0, 0, 0, *[255] * 21]
    (place / "001.png").write_bytes(palette(LABELS.astype(np.uint8), white))
    (tmp_path / "others" / "labels.json").write_text('{"shaft": 1, "wrist": 7}')
    found = read_annotations(tmp_path / "others", Sequence.open(tiny_sequence(masks=False)))
    (frame,) = found.frames
    assert found.label_names == ["shaft", "wrist"] and frame.labels is not None
    assert np.array_equal(frame.labels, np.where(LABELS == 7, 2, LABELS))
    assert list(found.remarks) == ["labels are palette indices"]


def test_a_palette_of_grey_values_in_their_order_is_none(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    (place / "001.png").write_bytes(palette(BLURRED, [level for level in range(256) for _ in range(3)]))
    found = read_annotations(tmp_path / "others", Sequence.open(tiny_sequence(masks=False)))
    (frame,) = found.frames
    assert found.label_names == ["instrument"] and frame.labels is not None
    assert np.array_equal(frame.labels > 0, BLURRED >= 128)


def test_jpeg_is_read_for_black_and_white_alone(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    sequence = Sequence.open(tiny_sequence(masks=False))
    (place / "001.jpg").write_bytes(pillow(LABELS.astype(np.uint8) * 30, "JPEG", quality=80))
    with pytest.raises(SequenceError, match=r"which JPEG compression has changed\. Save labels as PNG"):
        list(read_annotations(tmp_path / "others", sequence).frames)
    (place / "001.jpg").write_bytes(pillow(np.uint8(3) * DISC, "JPEG", quality=80))
    (frame,) = read_annotations(tmp_path / "others", sequence).frames
    assert frame.labels is not None and not frame.labels.any()


def test_interpolated_labels_are_refused(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    place = tmp_path / "others" / "left"
    place.mkdir(parents=True)
    (place / "001.png").write_bytes(png(cv2.GaussianBlur((LABELS * 30).astype(np.uint8), (0, 0), 3)))
    found = read_annotations(tmp_path / "others", Sequence.open(tiny_sequence(masks=False)))
    with pytest.raises(SequenceError, match="Resize labels by nearest neighbour"):
        list(found.frames)


def test_white_and_transparency_that_contradict_are_refused(tmp_path: Path) -> None:
    (tmp_path / "mask.png").write_bytes(png(np.dstack([WHITE, WHITE, WHITE, WHITE[::-1]])))
    with pytest.raises(SequenceError, match="Save it without transparency"):
        read_mask(tmp_path / "mask.png")


def test_what_is_changed_about_a_sequences_files_is_said_when_it_is_opened(tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence()
    for number in (1, 2, 3):
        deep = read_image(path.parent / f"regular/left/{number:03d}.png").astype(np.uint16) * 16 + 3
        cv2.imwrite(str(path.parent / f"regular/left/{number:03d}.png"), deep)
        mask = read_mask(path.parent / f"masks/left/{number:03d}.png")
        soft = cv2.GaussianBlur(np.uint8(255) * mask, (0, 0), 1)
        cv2.imwrite(str(path.parent / f"masks/left/{number:03d}.png"), soft)
    lines: list[str] = []
    sequence = Sequence.open(path, progress=lines.append)
    assert {f"note: {remark}" for remark in sequence.remarks} <= set(lines)
    assert any("left: images: 12 of 16 bits are used" in remark for remark in sequence.remarks)
    assert any("left: masks: grey borders" in remark for remark in sequence.remarks)
    assert 100 < sequence.frame(0).images["left"].mean() < 160


def test_a_frame_with_more_bits_than_the_others_asks_for_them(tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence(frames=30)
    for number in range(1, 31):
        file = path.parent / f"regular/left/{number:03d}.png"
        cv2.imwrite(str(file), read_image(file).astype(np.uint16) * (200 if number == 2 else 16))
    with pytest.raises(SequenceError, match=r"002.png has 16-bit values.*Set `bits = 16`"):
        Sequence.open(path).frame(1)
    path.write_text(path.read_text().replace("[[cameras]]", "[[cameras]]\nbits = 16"))
    assert Sequence.open(path).frame(1).images["left"].mean() > 50


@pytest.mark.parametrize(
    ("options", "upright"),
    [
        ({"rotation": 90}, np.rot90),
        ({"rotation": 180}, lambda stored: np.rot90(stored, 2)),
        ({"rotation": 270}, lambda stored: np.rot90(stored, 3)),
        ({"mirrored": True}, lambda stored: stored[:, ::-1]),
    ],
)
def test_display_matrices_are_applied(
    tmp_path: Path, options: dict, upright: Callable[[np.ndarray], np.ndarray]
) -> None:
    path = write_video(tmp_path / "video.mp4", [PICTURE, PICTURE // 2, PICTURE // 3], options={"crf": "4"}, **options)
    reader = Video(path, (0, 1, 2))
    for index in (2, 0, 1):
        wanted = upright(PICTURE // (index + 1))
        assert np.abs(reader.read(index).astype(int) - wanted).mean() < 4
    found = find_images(path)
    assert found.size == upright(PICTURE).shape[1::-1] and "display matrix" in found.remarks[0]


def test_of_interlaced_frames_one_field_is_used(tmp_path: Path) -> None:
    def bar(column: int) -> np.ndarray:
        image = np.full((HEIGHT, WIDTH, 3), 30, np.uint8)
        image[:, column : column + 10] = 220
        return image

    woven = []
    for number in range(4):
        frame = bar(10 + 12 * number)
        frame[1::2] = bar(16 + 12 * number)[1::2]
        woven.append(frame)
    path = write_video(tmp_path / "video.mp4", woven, options={"x264-params": "interlaced=1:tff=1", "crf": "4"})
    reader = Video(path, (0, 1, 2, 3))
    for index in (3, 0):
        assert np.abs(reader.read(index).astype(int) - bar(10 + 12 * index)).mean() < 6
    assert "interlaced; only the top field" in reader.remarks()[0]
    whole = Video(path, (0, 1), deinterlace=False)
    assert np.abs(whole.read(1).astype(int) - woven[1]).mean() < 6 and "both fields" in whole.remarks()[0]


@pytest.mark.parametrize(
    "options",
    [
        {"pixels": "yuv444p"},
        {"pixels": "yuv420p10le"},
        {"options": {"bf": "3", "g": "10", "crf": "4"}},
        {"milliseconds": [0, 33, 167, 200, 667, 700, 1333, 1367, 1433, 2000]},
        {"codec": "ffv1", "pixels": "bgr0", "options": {}},
    ],
)
def test_videos_of_other_kinds_give_each_frame_and_its_time(tmp_path: Path, options: dict) -> None:
    odd = PICTURE[:-1, :-1] if options.get("pixels") == "yuv444p" else PICTURE
    images = [np.roll(odd, 7 * number, axis=1) for number in range(10)]
    path = write_video(tmp_path / "video.mkv", images, 30, **{"options": {"crf": "4"}, **options})
    reader = Video(path, tuple(range(10)))
    for index in (7, 2, 9, 0):
        assert np.abs(reader.read(index).astype(int) - images[index]).mean() < 5
    found = find_images(path)
    times = np.array(options.get("milliseconds", np.arange(10) / 0.03)) / 1000
    assert found.times is not None and np.abs(found.times - found.times[0] - times).max() < 2e-3
    assert found.size == (odd.shape[1], odd.shape[0])


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
