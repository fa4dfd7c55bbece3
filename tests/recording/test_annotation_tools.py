"""Files of LabelMe, X-AnyLabeling, Label Studio and YOLO, as these tools write them, and hostile ones."""

import base64
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from carts_core.errors import SequenceError
from carts_core.export import Dataset, export, measured_frames
from carts_core.recording import Sequence
from carts_core.recording.annotations import Annotations, FrameAnnotation, read_annotations
from carts_core.recording.annotations.label_studio import opacity_of_brush
from carts_core.recording.annotations.shapes import corners_of_box, mask_of_ellipse, mask_of_polygon

HEIGHT, WIDTH = 72, 96
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH] + 0.5
"""Of the pixels' centres."""
CIRCLE = (COLUMNS - 40.3) ** 2 + (ROWS - 30.7) ** 2 <= 15.5**2
BOX = np.zeros((HEIGHT, WIDTH), bool)
BOX[10:20, 50:80] = True
TRIANGLE = np.array([[5.0, 60.0], [30.5, 40.25], [60.0, 70.0]])
INSIDE_TRIANGLE = mask_of_polygon(TRIANGLE, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(cameras=("left", "right"), masks=False))


Frames = dict[tuple[int, str], FrameAnnotation]


def read(source: Path, sequence: Sequence, **options: Any) -> tuple[Frames, Annotations]:
    found = read_annotations(source, sequence, **options)
    return {(each.frame, each.camera): each for each in found.frames}, found


def pixels(frame: FrameAnnotation, found: Annotations, label: str) -> np.ndarray:
    assert frame.labels is not None
    return frame.labels == found.label_names.index(label) + 1


def png_text(values: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return base64.b64encode(stream.getvalue()).decode()


# ---- LabelMe and X-AnyLabeling --------------------------------------------------------------------------------------


def shape(label: str, points: Any, kind: str = "polygon", **further: Any) -> dict[str, Any]:
    given = {"label": label, "points": points, "group_id": None, "description": "", "shape_type": kind, "flags": {}}
    return given | {"mask": None} | further


def write_labelme(path: Path, *shapes: dict[str, Any], **changes: Any) -> Path:
    content = {
        "version": "5.5.0",
        "flags": {},
        "shapes": list(shapes),
        "imagePath": f"{path.stem}.png",
        "imageData": base64.b64encode(b"never decoded").decode(),
        "imageHeight": HEIGHT,
        "imageWidth": WIDTH,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content | changes, indent=2))
    return path


def x_shape(label: str, points: Any, kind: str, **further: Any) -> dict[str, Any]:
    given = {"kie_linking": [], "label": label, "score": 0.9, "points": points, "group_id": None, "description": ""}
    return given | {"difficult": False, "shape_type": kind, "flags": {}, "attributes": {}} | further


def test_shapes_of_labelme_cover_the_pixels_whose_centres_are_inside(sequence: Sequence, tmp_path: Path) -> None:
    stored = CIRCLE[20:40, 30:50]
    write_labelme(
        tmp_path / "left" / "001.json",
        shape("shaft", TRIANGLE.tolist()),
        shape("box", [[80.0, 20.0], [50.0, 10.0]], "rectangle"),
    )
    circle = shape("wrist", [[40.3, 30.7], [40.3, 46.2]], "circle")
    tips = [shape("tip", [[4.5, 6.25]], "point", group_id=group) for group in (1, 2)]
    write_labelme(tmp_path / "left" / "002.json", circle, *tips, shape("end", [[1, 2]], "point"))
    mask = shape("jaw", [[30, 20], [49, 39]], "mask", mask=png_text(stored.astype(np.uint8)))
    write_labelme(tmp_path / "right" / "002.json", mask)
    frames, found = read(tmp_path, sequence)
    assert found.kind == "LabelMe" and not found.unknown and not found.remarks
    first = frames[0, "left"]
    assert np.array_equal(pixels(first, found, "shaft"), INSIDE_TRIANGLE & ~BOX)
    assert np.array_equal(pixels(first, found, "box"), BOX)
    assert np.array_equal(pixels(frames[1, "left"], found, "wrist"), CIRCLE)
    assert frames[1, "left"].keypoints == {"tip.1": (4.5, 6.25), "tip.2": (4.5, 6.25), "end": (1.0, 2.0)}
    jaw = pixels(frames[1, "right"], found, "jaw")
    assert np.array_equal(jaw[20:40, 30:50], stored) and jaw.sum() == stored.sum()


@pytest.mark.parametrize("values", [255, 1, True])
def test_masks_of_labelme_are_placed_at_their_box_and_clipped(sequence: Sequence, tmp_path: Path, values: Any) -> None:
    stored = np.array([[1, 0, 1], [0, 1, 1]]) * values
    stored = stored.astype(bool if values is True else np.uint8)
    jaw = shape("jaw", [[-1, 71.6], [1, 72.6]], "mask", mask=png_text(stored))
    path = write_labelme(tmp_path / "left_001.json", jaw)
    frames, found = read(path, sequence)
    assert np.argwhere(pixels(frames[0, "left"], found, "jaw")).tolist() == [[71, 1]]


def test_extensions_of_x_anylabeling_are_read(sequence: Sequence, tmp_path: Path) -> None:
    turned = corners_of_box((30.0, 20.0), (20.0, 10.0), np.radians(30))
    write_labelme(
        tmp_path / "001.json",
        x_shape("box", [[50, 10], [80, 10], [80, 20], [50, 20]], "rectangle"),
        x_shape("wrist", turned.tolist(), "rotation", direction=0.52),
        x_shape("edge", [[1, 1], [5, 5]], "line"),
        imageData=None,
        version="3.2.1",
        checked=True,
        description="",
    )
    frames, found = read(tmp_path, sequence, camera="left")
    assert found.kind == "X-AnyLabeling" and found.label_names == ["box", "wrist"]
    assert np.array_equal(pixels(frames[0, "left"], found, "box"), BOX)
    along = (COLUMNS - 30) * np.cos(np.pi / 6) + (ROWS - 20) * np.sin(np.pi / 6)
    down = (ROWS - 20) * np.cos(np.pi / 6) - (COLUMNS - 30) * np.sin(np.pi / 6)
    wanted = (along > 0) & (along < 20) & (down > 0) & (down < 10)
    assert np.array_equal(pixels(frames[0, "left"], found, "wrist"), wanted)
    assert list(found.remarks) == ["a line (edge) of 001.png left out: lines have no area; draw polygons"]


def test_rotated_rectangles_of_labelme_are_read(sequence: Sequence, tmp_path: Path) -> None:
    turned = corners_of_box((30.0, 20.0), (20.0, 10.0), np.radians(30))
    path = write_labelme(tmp_path / "left_001.json", shape("a", turned.tolist(), "oriented_rectangle"), version="6.3.1")
    frames, found = read(path, sequence)
    assert np.array_equal(pixels(frames[0, "left"], found, "a"), mask_of_polygon(turned, HEIGHT, WIDTH))


def test_background_of_labelme_removes_labels(sequence: Sequence, tmp_path: Path) -> None:
    triangle = shape("shaft", TRIANGLE.tolist())
    hole = shape("_background_", [[20, 55], [30, 65]], "rectangle")
    frames, found = read(write_labelme(tmp_path / "left_001.json", triangle, hole), sequence)
    wanted = INSIDE_TRIANGLE.copy()
    wanted[55:65, 20:30] = False
    assert found.label_names == ["shaft"] and np.array_equal(pixels(frames[0, "left"], found, "shaft"), wanted)


def test_paths_of_labelme_are_names_that_are_never_opened(sequence: Sequence, tmp_path: Path) -> None:
    triangle = shape("shaft", TRIANGLE.tolist())
    write_labelme(tmp_path / "a.json", triangle, imagePath="..\\..\\right\\frame_003.jpg")
    write_labelme(tmp_path / "b.json", triangle, imagePath="../../../../etc/passwd")
    frames, found = read(tmp_path, sequence)
    assert list(frames) == [(2, "right")] and found.unknown[0].endswith("etc/passwd")
    assert found.remarks["the image named in the file (imagePath) is used, not the name of the file"] == 2


def bomb(side: int) -> str:
    return png_text(np.zeros((side, side), np.uint8))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (shape("a", [[1, float("1e300")], [2, 3], [4, 5]]), "a point is not finite or far outside"),
        (shape("a", [[1, 2], [3, 4]]), "a polygon has 2 vertices; 3 to 100000 are allowed"),
        (shape("a", [[1, 2]] * 100_001), "a polygon has 100001 vertices"),
        (shape("a", [[1, 2, 3]] * 2), "its points are not pairs of x and y"),
        (shape("a", "text"), "could not convert string to float"),
        (shape("a", [[1, 1], [1, 1]], "circle"), "its radii are 0 and 0"),
        (shape("a", [[1, 1], [2, 2]], "star"), "shapes of the type 'star' are not supported"),
        (shape("a", [[0, 0], [9, 9]], "mask"), "its mask is missing"),
        (shape("a", [[0, 0], [9, 9]], "mask", mask="!!"), "left out"),
        (shape("a", [[0, 0], [9, 9]], "mask", mask="aGVsbG8="), "its mask cannot be decoded"),
        (shape("a", [[0, 0], [9, 9]], "mask", mask=bomb(4000)), "its mask is 4000 x 4000 pixels; at most 11 x 11"),
        (shape("a", [[0, 0], [9, 9]], "mask", mask=bomb(5)), "its mask is 5 x 5 in a box of 10 x 10"),
        (shape("a", [[0, 0], [3999, 3999]], "mask", mask=bomb(4000)), "at most 96 x 72"),
    ],
)
def test_invalid_shapes_of_labelme_are_left_out(
    sequence: Sequence, tmp_path: Path, wrong: dict[str, Any], message: str
) -> None:
    frames, found = read(write_labelme(tmp_path / "left_001.json", shape("b", TRIANGLE.tolist()), wrong), sequence)
    assert np.array_equal(pixels(frames[0, "left"], found, "b"), INSIDE_TRIANGLE)
    (remark,) = found.remarks
    assert remark.startswith(f"a {wrong['shape_type']} (a) of left_001.png left out: ") and message in remark


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"imageHeight": 10, "imageWidth": 12}, "is 12 x 10 pixels, but images of camera 'left' are 96 x 72"),
        ({"imageHeight": 10**9}, "its size is 96 x 1000000000"),
        ({"shapes": [shape("a", [[1, 1]], "point")] * 5001}, "it has 5001 shapes; at most 5000 are allowed"),
        ({"shapes": [shape("a", [[1, 1]], "point")] * 201}, "the image has 201 keypoints; at most 200 are allowed"),
        ({"flags": float("nan")}, "is not readable JSON"),
    ],
)
def test_invalid_files_of_labelme_are_refused(
    sequence: Sequence, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = write_labelme(tmp_path / "left_001.json", **changes)
    with pytest.raises(SequenceError, match=message):
        read(path, sequence)


def test_a_size_that_is_not_stated_is_that_of_the_camera(sequence: Sequence, tmp_path: Path) -> None:
    path = write_labelme(
        tmp_path / "left_001.json", shape("a", TRIANGLE.tolist()), imageHeight=-1, imageWidth=None, imageData=None
    )
    frames, found = read(path, sequence)
    assert np.array_equal(pixels(frames[0, "left"], found, "a"), INSIDE_TRIANGLE)


# ---- Label Studio ---------------------------------------------------------------------------------------------------


def brush_codes(opacity: np.ndarray, sizes: tuple[int, ...] = (3, 4, 8, 16)) -> list[int]:
    """Run-length encoding of red, green, blue and opacity, written from its description: runs of equal words, and
    sequences of different ones."""
    words = np.repeat(opacity.ravel(), 4)
    bits = f"{len(words):032b}{7:05b}" + "".join(f"{size - 1:04b}" for size in sizes)

    def count(length: int) -> str:
        which = next(n for n, size in enumerate(sizes) if length <= 1 << size)
        return f"{which:02b}{length - 1:0{sizes[which]}b}"

    def pieces() -> Iterator[str]:
        ends = [*(np.flatnonzero(np.diff(words)) + 1).tolist(), len(words)]
        start, literal = 0, []
        for end in ends:
            if end - start < 3:
                literal += words[start:end].tolist()
            else:
                if literal:
                    yield "0" + count(len(literal)) + "".join(f"{word:08b}" for word in literal)
                    literal = []
                for begin in range(start, end, 1 << sizes[-1]):
                    yield "1" + count(min(end - begin, 1 << sizes[-1])) + f"{words[start]:08b}"
            start = end
        if literal:
            yield "0" + count(len(literal)) + "".join(f"{word:08b}" for word in literal)

    bits += "".join(pieces())
    bits += "0" * (-len(bits) % 8)
    return [int(bits[start : start + 8], 2) for start in range(0, len(bits), 8)]


def region(kind: str, value: dict[str, Any], **further: Any) -> dict[str, Any]:
    given = {"original_width": WIDTH, "original_height": HEIGHT, "image_rotation": 0, "value": value, "id": "x1"}
    return given | {"from_name": "label", "to_name": "image", "type": kind, "origin": "manual"} | further


def task(image: str, *regions: dict[str, Any], **further: Any) -> dict[str, Any]:
    annotation = {"id": 5, "completed_by": 1, "result": list(regions), "was_cancelled": False, "ground_truth": False}
    annotation |= {"created_at": "2026-03-09T22:16:08.728353Z", "updated_at": "2026-03-09T22:16:08.728378Z"}
    given = {"id": 1, "annotations": [annotation], "file_upload": "1a2b3c4d-x.png", "drafts": [], "predictions": []}
    return given | {"data": {"image": image}, "meta": {}, "project": 3} | further


def percent(points: np.ndarray) -> list[list[float]]:
    return (points / (WIDTH, HEIGHT) * 100).tolist()


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_regions_of_label_studio_cover_the_pixels_whose_centres_are_inside(sequence: Sequence, tmp_path: Path) -> None:
    polygon = {"points": percent(TRIANGLE), "closed": True, "polygonlabels": ["shaft"]}
    (corner,), (size,) = percent(np.array([[50.0, 10.0]])), percent(np.array([[30.0, 10.0]]))
    place = {"x": corner[0], "y": corner[1], "width": size[0], "height": size[1], "rotation": 0}
    box = place | {"rectanglelabels": ["box"]}
    brush = {"format": "rle", "rle": brush_codes(np.uint8(255) * CIRCLE), "brushlabels": ["wrist"]}
    ((x, y), (a, b)) = percent(np.array([[40.0, 30.0], [20.0, 8.0]]))
    ellipse = {"x": x, "y": y, "radiusX": a, "radiusY": b, "rotation": 30, "ellipselabels": ["jaw"]}
    tip = {"x": 12.5, "y": 50.0, "width": 0.3, "keypointlabels": ["tip"]}
    tasks = [
        task(
            "/data/upload/3/1a2b3c4d-left_001.png",
            region("polygonlabels", polygon),
            region("rectanglelabels", box, id="x2"),
            region("keypointlabels", tip, id="x3"),
        ),
        task("/data/local-files/?d=marked%2Fright%2F002.png", region("brushlabels", brush)),
        task("s3://bucket/left/003.jpg", region("ellipselabels", ellipse)),
    ]
    frames, found = read(write_json(tmp_path / "project-3.json", tasks), sequence)
    assert found.kind == "Label Studio" and not found.unknown and not found.remarks
    first = frames[0, "left"]
    assert np.array_equal(pixels(first, found, "shaft"), INSIDE_TRIANGLE & ~BOX)
    assert np.array_equal(pixels(first, found, "box"), BOX)
    assert first.keypoints == {"tip": (12.0, 36.0)}
    assert np.array_equal(pixels(frames[1, "right"], found, "wrist"), CIRCLE)
    along = (COLUMNS - 40) * np.cos(np.pi / 6) + (ROWS - 30) * np.sin(np.pi / 6)
    across = (ROWS - 30) * np.cos(np.pi / 6) - (COLUMNS - 40) * np.sin(np.pi / 6)
    assert np.array_equal(pixels(frames[2, "left"], found, "jaw"), (along / 20) ** 2 + (across / 8) ** 2 <= 1)


def test_labels_of_separate_controls_and_images_of_one_task_are_joined(sequence: Sequence, tmp_path: Path) -> None:
    polygon = {"points": percent(TRIANGLE), "closed": True}
    both = [
        region("polygon", polygon, to_name="left"),
        region("labels", polygon | {"labels": ["shaft"]}, to_name="left"),
        region("choices", {"choices": ["good"]}, id="x9", to_name="left"),
        region("polygonlabels", polygon | {"polygonlabels": ["wrist"]}, id="x2", to_name="right"),
    ]
    data = {"left": "left/001.png", "right": "right/001.png"}
    frames, found = read(write_json(tmp_path / "a.json", [task("", *both, data=data)]), sequence)
    assert set(frames) == {(0, "left"), (0, "right")} and found.label_names == ["shaft", "wrist"]
    assert np.array_equal(pixels(frames[0, "left"], found, "shaft"), INSIDE_TRIANGLE)


def test_of_several_annotations_the_ground_truth_or_the_newest_is_used(sequence: Sequence, tmp_path: Path) -> None:
    def annotation(label: str, day: int, **further: Any) -> dict[str, Any]:
        polygon = {"points": percent(TRIANGLE), "polygonlabels": [label]}
        return {"result": [region("polygonlabels", polygon)], "updated_at": f"2026-01-{day:02d}"} | further

    old, new = annotation("old", 1), annotation("new", 2)
    cancelled, truth = annotation("cancelled", 3, was_cancelled=True), annotation("truth", 1, ground_truth=True)
    for given, label in (([old, new, cancelled], "new"), ([truth, new], "truth"), ([old, cancelled], "old")):
        _, found = read(write_json(tmp_path / "a.json", [task("left_001.png", annotations=given)]), sequence)
        assert found.label_names == [label]
        assert sum("has 2 annotations" in remark for remark in found.remarks) == (label != "old")
    _, found = read(write_json(tmp_path / "a.json", [task("left_001.png", annotations=[], predictions=[{}])]), sequence)
    assert "accept them in Label Studio" in next(iter(found.remarks))


@pytest.mark.parametrize("seed", range(3))
def test_brush_masks_are_decoded(seed: int) -> None:
    rng = np.random.default_rng(seed)
    opacity = np.where(CIRCLE, 255, 0).astype(np.uint8)
    opacity[rng.random(CIRCLE.shape) < 0.2 * seed] = rng.integers(0, 256)
    assert np.array_equal(opacity_of_brush(brush_codes(opacity), HEIGHT, WIDTH), opacity)
    flat = rng.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    words = "".join(f"0{3:02b}{255:016b}" + "".join(f"{w:08b}" for w in block) for block in
                    np.split(np.repeat(flat.ravel(), 4), HEIGHT * WIDTH * 4 // 256))  # fmt: skip
    bits = f"{flat.size * 4:032b}{7:05b}" + "0010001101111111" + words
    bits += "0" * (-len(bits) % 8)
    codes = [int(bits[start : start + 8], 2) for start in range(0, len(bits), 8)]
    assert np.array_equal(opacity_of_brush(codes, HEIGHT, WIDTH), flat)


RUNS = brush_codes(np.uint8(255) * CIRCLE)
POLYGON = {"points": percent(TRIANGLE), "polygonlabels": ["a"]}


@pytest.mark.parametrize(
    ("value", "further", "message"),
    [
        ({"rle": [255] * 7}, {}, "the run lengths have 4294967295 values, not four for each of 96 x 72 pixels"),
        ({"rle": RUNS[:-9]}, {}, "the run lengths do not cover the image exactly"),
        ({"rle": []}, {}, "the run lengths have 0 values"),
        ({"rle": 10**12}, {}, "its run lengths are not a list of bytes"),
        ({"rle": [*RUNS[:10], 256]}, {}, "left out"),
        ({"rle": [*RUNS[:4], 0x78, *RUNS[5:]]}, {}, "its values have 16 bits instead of 8"),
        ({"points": [[1, 2], [3, 4]]}, {}, "a polygon has 2 vertices"),
        ({"points": [[1e300, 1], [2, 2], [3, 3]]}, {}, "a point is not finite or far outside"),
        ({"x": 1, "y": 1, "radiusX": -1, "radiusY": 1}, {}, "its radii are"),
        ({"imageDataURL": "data:"}, {}, "its type is not supported"),
        (POLYGON, {"image_rotation": 90}, "the image was rotated by 90 degrees"),
        (POLYGON, {"original_width": None}, "left out"),
        (POLYGON, {"original_width": 10**6}, "its size is 1000000 x 72"),
        (POLYGON | {"closed": False}, {}, "it is not closed"),
    ],
)
def test_invalid_regions_of_label_studio_are_left_out(
    sequence: Sequence, tmp_path: Path, value: dict[str, Any], further: dict[str, Any], message: str
) -> None:
    good = region("polygonlabels", {"points": percent(TRIANGLE), "polygonlabels": ["b"]}, id="good")
    wrong = region("brushlabels", {"brushlabels": ["a"]} | value, **further)
    frames, found = read(write_json(tmp_path / "a.json", [task("left_001.png", good, wrong)]), sequence)
    assert np.array_equal(pixels(frames[0, "left"], found, "b"), INSIDE_TRIANGLE)
    (remark,) = found.remarks
    assert "left out: " in remark and message in remark


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([{"annotation_id": 1, "annotator": 1, "image": "a.png", "label": []}], "as JSON-MIN. Export it as JSON"),
        ([], "is not a file of COCO"),
        ({"items": [], "categories": {}}, "is not a file of COCO"),
        ([task("a.png", annotations=5)], "is not an export of Label Studio"),
        ([task("left_001.png", region("polygonlabels", POLYGON, original_width=50))], "is 50 x 72 pixels, but images"),
    ],
)
def test_other_json_is_refused(sequence: Sequence, tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        read(write_json(tmp_path / "a.json", content), sequence)


# ---- YOLO -----------------------------------------------------------------------------------------------------------


def write_yolo(folder: Path, lines: dict[str, str], names: str = "names:\n  0: shaft\n  1: wrist\n") -> Path:
    for name, text in lines.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    if names:
        (folder / "data.yaml").write_text(f"path: ../datasets/marked\ntrain: images/train\nval: images/val\n{names}")
    return folder


def line(index: int, points: np.ndarray) -> str:
    return f"{index} {' '.join(f'{value:.9f}' for value in (points / (WIDTH, HEIGHT)).ravel())}\n"


@pytest.mark.parametrize("layout", ["labels/train/left_001.txt", "train/labels/left_001.txt", "left_001.txt"])
def test_polygons_of_yolo_are_read(sequence: Sequence, tmp_path: Path, layout: str) -> None:
    box = corners_of_box((50.0, 10.0), (30.0, 10.0))
    folder = write_yolo(tmp_path / "marked", {layout: line(0, TRIANGLE) + "\n" + line(1, box)})
    photo = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    image = folder / layout.replace("labels", "images").replace(".txt", ".png")
    image.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(image), photo)
    for source in (folder, folder / "data.yaml"):
        frames, found = read(source, sequence)
        assert found.kind == "YOLO" and found.label_names == ["shaft", "wrist"] and not found.remarks
        assert np.array_equal(pixels(frames[0, "left"], found, "wrist"), BOX)
        assert np.array_equal(pixels(frames[0, "left"], found, "shaft"), INSIDE_TRIANGLE & ~BOX)


def test_names_of_yolo_are_found_above_the_labels_unless_confined(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_yolo(tmp_path / "marked", {"labels/left_001.txt": line(1, TRIANGLE)}, "names: [shaft, wrist]\n")
    assert read(folder / "labels", sequence)[1].label_names == ["wrist"]
    _, found = read(folder / "labels", sequence, confined=True)
    assert found.label_names == ["class 1"] and "there is no data.yaml" in next(iter(found.remarks))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("0 0.5 0.5 0.2 0.2", "it is a bounding box, not a polygon"),
        ("0 0.1 0.1 0.2 0.2 0.3 0.3 0.9", "7 numbers are not x and y of vertices; export without confidences"),
        ("0 nan 0.1 0.2 0.2 0.3 0.3", "a vertex is not finite"),
        ("0 10 10 50 50 30 30", "or not normalized"),
        ("7 0.1 0.1 0.2 0.2 0.3 0.3", "class 7 has no name in the file of class names"),
        ("a b c d e f g", "left out"),
        ("0 " + "0.1 0.2 " * 100_001, "a polygon has 100001 vertices"),
    ],
)
def test_invalid_lines_of_yolo_are_left_out(sequence: Sequence, tmp_path: Path, wrong: str, message: str) -> None:
    write_yolo(tmp_path / "marked", {"labels/left_001.txt": f"{line(0, TRIANGLE)}{wrong}\n"})
    frames, found = read(tmp_path / "marked", sequence)
    assert np.array_equal(pixels(frames[0, "left"], found, "shaft"), INSIDE_TRIANGLE)
    (remark,) = found.remarks
    assert remark.startswith("line 2 of marked/labels/left_001.txt left out: ") and message in remark


def test_data_sets_of_yolo_that_are_no_segmentations_are_refused(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_yolo(tmp_path / "a", {"labels/left_001.txt": line(0, TRIANGLE)}, "kpt_shape: [3, 2]\nnames: [a]\n")
    with pytest.raises(SequenceError, match="the labels are boxes with keypoints"):
        read(folder, sequence)
    with pytest.raises(SequenceError, match="has no YOLO labels"):
        read(write_yolo(tmp_path / "b", {"b.md": ""}) / "data.yaml", sequence)


def test_exported_yolo_labels_come_back_to_a_pixel(sequence: Sequence, tmp_path: Path) -> None:
    dataset = Dataset(sequence, tuple(measured_frames(sequence, range(2))), sequence.scene, "regular", parts="arms")
    folder = export(dataset, "yolo", tmp_path / "exported")
    frames, found = read(folder, sequence)
    assert len(frames) == 4 and found.kind == "YOLO" and not found.unknown
    for (index, name), frame in frames.items():
        link_ids = dataset.renderers[name].segment_links(dataset.state(dataset.frames[index]))[0]
        assert frame.labels is not None
        wanted = np.asarray(link_ids >= 0)
        near = cv2.dilate(wanted.astype(np.uint8), np.ones((3, 3))) - cv2.erode(
            wanted.astype(np.uint8), np.ones((3, 3))
        )
        assert not ((frame.labels > 0) ^ wanted)[near == 0].any()


# ---- Recognition and shapes -----------------------------------------------------------------------------------------


def test_folders_with_several_formats_ask_for_one(sequence: Sequence, tmp_path: Path) -> None:
    write_labelme(tmp_path / "001.json", shape("shaft", TRIANGLE.tolist()))
    (tmp_path / "masks").mkdir()
    assert cv2.imwrite(str(tmp_path / "masks" / "002.png"), np.uint8(255) * CIRCLE)
    with pytest.raises(
        SequenceError, match=r"several formats \(labelme, masks\). Choose one with Source format \(--format\)"
    ):
        read(tmp_path, sequence, camera="left")
    assert list(read(tmp_path, sequence, camera="left", format="labelme")[0]) == [(0, "left")]
    assert list(read(tmp_path, sequence, camera="left", format="masks")[0]) == [(1, "left")]
    with pytest.raises(SequenceError, match="is a folder, but an export in the format coco is a file"):
        read(tmp_path, sequence, format="coco")
    with pytest.raises(SequenceError, match="has the format labelme, not coco"):
        read(tmp_path / "001.json", sequence, format="coco")
    with pytest.raises(SequenceError, match="has no YOLO labels"):
        read(tmp_path, sequence, format="yolo")
    with pytest.raises(SequenceError, match=r"'bmp' is not a format of annotations\. Choose one of: coco"):
        read(tmp_path, sequence, format="bmp")


def test_images_beside_files_of_labelme_are_no_masks(sequence: Sequence, tmp_path: Path) -> None:
    write_labelme(tmp_path / "left_001.json", shape("shaft", TRIANGLE.tolist()))
    (tmp_path / "notes.json").write_text("{}")
    for name in ("left_001.png", "left_002.png"):
        photo = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        assert cv2.imwrite(str(tmp_path / name), photo)
    frames, found = read(tmp_path, sequence)
    assert list(frames) == [(0, "left")] and list(found.remarks) == ["notes.json skipped: it is not a file of LabelMe"]


def test_links_to_annotations_are_ignored_if_confined(sequence: Sequence, tmp_path: Path) -> None:
    write_labelme(tmp_path / "elsewhere" / "left_001.json", shape("shaft", TRIANGLE.tolist()))
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "left_001.json").symlink_to(tmp_path / "elsewhere" / "left_001.json")
    assert len(read(tmp_path / "own", sequence)[0]) == 1
    with pytest.raises(SequenceError, match="has no masks"):
        read(tmp_path / "own", sequence, confined=True)


def test_many_crossings_give_the_same_polygon() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 120, (60, 2))
    far = np.zeros((HEIGHT, WIDTH), bool)
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            x = x0 + (ROWS - y0) * (x1 - x0) / (y1 - y0)
        far ^= ((ROWS > y0) != (ROWS > y1)) & (COLUMNS > x)
    assert np.array_equal(mask_of_polygon(points, HEIGHT, WIDTH), far)
    zigzag = np.column_stack([np.linspace(0, WIDTH, 40_000), np.tile([0.0, HEIGHT], 20_000)])
    assert mask_of_polygon(zigzag, HEIGHT, WIDTH).shape == (HEIGHT, WIDTH)


def test_ellipses_outside_the_image_are_clipped() -> None:
    assert not mask_of_ellipse((-50, -50), (10, 10), 0.0, HEIGHT, WIDTH).any()
    assert mask_of_ellipse((48, 36), (500, 500), 0.3, HEIGHT, WIDTH).all()
