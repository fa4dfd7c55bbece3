"""Masks and keypoints of others, in the formats of their owners' tools."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from videos import write_video

from carts_core.errors import SequenceError
from carts_core.export import Dataset, FormatName, export, measured_frames
from carts_core.model.camera import Camera
from carts_core.recording import Sequence
from carts_core.recording.annotations import read_annotations
from carts_core.recording.annotations.shapes import mask_of_polygon, mask_of_runs, runs_of_text

HEIGHT, WIDTH = 72, 96


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(cameras=("left", "right"), masks=False))


def all_of(source: Path, sequence: Sequence, camera: str | None = None) -> tuple[dict, list[str], list[str]]:
    found = read_annotations(source, sequence, camera)
    frames = {(each.frame, each.camera): each for each in found.frames}
    return frames, found.label_names, found.unknown


def disc(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (rows - rng.uniform(20, 50)) ** 2 + (columns - rng.uniform(20, 70)) ** 2 < rng.uniform(8, 18) ** 2


@pytest.mark.parametrize("seed", range(4))
def test_compressed_run_lengths_are_those_of_pycocotools(seed: int) -> None:
    mask = disc(seed) ^ disc(seed + 10)
    counts = coco_mask.encode(np.asfortranarray(mask, np.uint8))["counts"]
    assert isinstance(counts, bytes)
    assert np.array_equal(mask_of_runs(runs_of_text(counts.decode()), HEIGHT, WIDTH, by_columns=True), mask)


@pytest.mark.parametrize("text", ["\x00", "~~~~", "o" * 30, "P", "é"])
def test_damaged_run_lengths_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="run lengths"):
        mask_of_runs(runs_of_text(text), HEIGHT, WIDTH, by_columns=True)


def test_a_polygon_covers_the_pixels_whose_centres_are_inside() -> None:
    square = mask_of_polygon(np.array([[2.0, 3.0], [6.0, 3.0], [6.0, 5.0], [2.0, 5.0]]), 8, 10)
    wanted = np.zeros((8, 10), bool)
    wanted[3:5, 2:6] = True
    assert np.array_equal(square, wanted)
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    circle = np.column_stack([40.3 + 20 * np.cos(angles), 30.7 + 20 * np.sin(angles)])
    rows, columns = np.mgrid[:72, :96] + 0.5
    assert (mask_of_polygon(circle, 72, 96) ^ ((columns - 40.3) ** 2 + (rows - 30.7) ** 2 < 400)).sum() <= 6
    outside = mask_of_polygon(np.array([[-50.0, -50.0], [200.0, -50.0], [200.0, 300.0], [-50.0, 300.0]]), 8, 10)
    assert outside.all()


@pytest.mark.parametrize(("kind", "file"), [("coco", ""), ("cvat", ""), ("masks", ""), ("masks", "binary")])
def test_exported_masks_come_back(sequence: Sequence, tmp_path: Path, kind: FormatName, file: str) -> None:
    parts = "links" if kind != "masks" else "arms"
    dataset = Dataset(sequence, tuple(measured_frames(sequence, range(3))), sequence.scene, "regular", parts=parts)
    folder = export(dataset, kind, tmp_path / "exported")
    frames, labels, unknown = all_of(folder / file, sequence)
    assert len(frames) == 6 and not unknown
    names = [link.name for link in dataset.links]
    for index, name in [(0, "left"), (2, "right")]:
        link_ids = dataset.renderers[name].segment_links(dataset.state(dataset.frames[index]))[0]
        found = frames[index, name].labels
        assert found is not None and np.array_equal(found > 0, link_ids >= 0)
        if file != "binary":
            assert all(labels[found[at] - 1] == names[link_ids[at]] for at in zip(*np.nonzero(found), strict=True))
    assert labels == ["arm"] if file == "binary" else set(labels) <= set(names)


def write_coco(path: Path, **changes) -> Path:
    content = {
        "images": [{"id": 7, "file_name": "left/frame_002.jpg", "width": WIDTH, "height": HEIGHT}],
        "categories": [{"id": 3, "name": "grasper", "keypoints": ["tip", "wrist"]}],
        "annotations": [
            {
                "id": 1,
                "image_id": 7,
                "category_id": 3,
                "segmentation": [[10, 10, 30, 10, 30, 20, 10, 20], [50, 50, 60, 50, 60, 60]],
                "keypoints": [12.5, 14.0, 2, 0, 0, 0],
            }
        ],
    } | changes
    path.write_text(json.dumps(content))
    return path


def test_polygons_and_keypoints_of_coco_are_read(sequence: Sequence, tmp_path: Path) -> None:
    frames, labels, _ = all_of(write_coco(tmp_path / "labels.json"), sequence)
    ((at, found),) = frames.items()
    assert at == (1, "left") and labels == ["grasper"]
    assert found.labels.sum() == 200 + 55 and found.labels[10:20, 10:30].all()
    assert found.keypoints == {"grasper.tip": (12.5, 14.0)}


def test_run_lengths_of_coco_that_are_not_compressed_are_read(sequence: Sequence, tmp_path: Path) -> None:
    segmentation = {"size": [HEIGHT, WIDTH], "counts": [HEIGHT * 3, HEIGHT, HEIGHT * (WIDTH - 4)]}
    marked = [{"image_id": 7, "category_id": 3, "segmentation": segmentation}]
    frames, _, _ = all_of(write_coco(tmp_path / "labels.json", annotations=marked), sequence)
    assert np.array_equal(np.nonzero(frames[1, "left"].labels.any(0))[0], [3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": [{"id": 7, "file_name": "left_2.png", "width": 10**9, "height": 5}]}, "its size is 1000000000 x 5"),
        ({"annotations": 5}, "is not a COCO file"),
    ],
)
def test_invalid_coco_files_are_refused(sequence: Sequence, tmp_path: Path, changes: dict, message: str) -> None:
    path = write_coco(tmp_path / "labels.json", **changes)
    with pytest.raises(SequenceError, match=message):
        all_of(path, sequence)


CVAT = (
    '<?xml version="1.0"?><annotations><version>1.1</version><image id="0" name="right_003.png" width="96" height="72">'
    '<polygon label="shaft" z_order="1" points="10,10;30,10;30,20;10,20"/>'
    '<mask label="wrist" z_order="0" left="25" top="10" width="10" height="2" rle="0, 20"/>'
    '<points label="tip" points="40.5,20.25"/>{more}</image></annotations>'
)


def test_polygons_masks_and_points_of_cvat_are_read_in_their_order(sequence: Sequence, tmp_path: Path) -> None:
    path = tmp_path / "annotations.xml"
    path.write_text(CVAT.format(more=""))
    frames, labels, _ = all_of(path, sequence)
    found = frames[2, "right"]
    assert labels == ["wrist", "shaft"] and found.keypoints == {"tip": (40.5, 20.25)}
    assert (found.labels == 2).sum() == 200 and (found.labels == 1).sum() == 10, "the shaft lies above the wrist"


def test_shapes_of_cvat_that_are_not_read_are_remarked(sequence: Sequence, tmp_path: Path) -> None:
    path = tmp_path / "annotations.xml"
    path.write_text(CVAT.format(more='<box label="shaft" xtl="1" ytl="1" xbr="5" ybr="5"/>'))
    found = read_annotations(path, sequence)
    list(found.frames)
    assert list(found.remarks) == ["a box (shaft) of right_003.png: only masks, polygons and points are read"]


def test_names_of_roboflow_have_no_frame_number_in_their_end(sequence: Sequence, tmp_path: Path) -> None:
    path = tmp_path / "annotations.xml"
    path.write_text(CVAT.format(more="").replace("right_003.png", "right_003_png.rf.2c6f1e0a9b7.jpg"))
    assert list(all_of(path, sequence)[0]) == [(2, "right")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!DOCTYPE a [<!ENTITY x 'y'>]><annotations/>", "declares a document type"),
        ("<annotations><image", "is not a CVAT file"),
        ("<annotations/>", "there is no <image>"),
    ],
)
def test_invalid_cvat_files_are_refused(sequence: Sequence, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "annotations.xml"
    path.write_text(text)
    with pytest.raises(SequenceError, match=message):
        all_of(path, sequence)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ('<mask label="a" left="90" top="0" width="10" height="1" rle="10"/>', "is not inside"),
        ('<mask label="a" left="0" top="0" width="10" height="1" rle="4"/>', "do not sum to 10 x 1"),
        ('<polygon label="a" points="1,nan;2,3;4,5"/>', "a point is not finite or far outside"),
    ],
)
def test_invalid_cvat_shapes_are_skipped(sequence: Sequence, tmp_path: Path, shape: str, message: str) -> None:
    (tmp_path / "annotations.xml").write_text(CVAT.format(more=""))
    wanted, _, _ = all_of(tmp_path / "annotations.xml", sequence)
    (tmp_path / "annotations.xml").write_text(CVAT.format(more=shape))
    found = read_annotations(tmp_path / "annotations.xml", sequence)
    frames = {(each.frame, each.camera): each for each in found.frames}
    for at, each in wanted.items():
        found_labels = frames[at].labels
        assert found_labels is not None and np.array_equal(found_labels, each.labels)
    (remark,) = found.remarks
    assert message in remark and "left out" in remark


TRIANGLE = [10, 10, 40, 10, 40, 40]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"segmentation": {"size": [HEIGHT, WIDTH], "counts": [5, 7]}}, "the run lengths do not sum to 96 x 72 pixels"),
        ({"segmentation": {"size": [9, 9], "counts": "1"}}, "a mask is 9 x 9 in an image of 96 x 72"),
        ({"segmentation": [[10, 10, 40, 10, 40]]}, "a polygon has 5 numbers, but needs x and y"),
        ({"segmentation": [[1, 2, 3, 4]]}, "a polygon has 4 numbers"),
        ({"segmentation": [[1e300] * 6]}, "is not finite or far outside"),
        ({"segmentation": [TRIANGLE], "category_id": 9}, "category 9 is not in the file"),
        ({"segmentation": [TRIANGLE], "image_id": 8}, "image 8 is not in the file"),
        ({"keypoints": [1, 2, 2] * 3}, "there are 3 keypoints, but 2 names"),
        ({"keypoints": [1, 2]}, "its keypoints have 2 numbers"),
    ],
)
def test_invalid_coco_annotations_are_skipped(sequence: Sequence, tmp_path: Path, wrong: dict, message: str) -> None:
    good = {"id": 1, "image_id": 7, "category_id": 3, "segmentation": [[50, 50, 60, 50, 60, 60]]}
    marked = [good, {"id": 52, "image_id": 7, "category_id": 3, **wrong}]
    found = read_annotations(write_coco(tmp_path / "labels.json", annotations=marked), sequence)
    (frame,) = found.frames
    assert frame.labels is not None and frame.labels.sum() == 55
    (remark,) = found.remarks
    assert remark.startswith("annotation 52 ") and "left out: " in remark and message in remark


def write_png(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values[..., ::-1] if values.ndim == 3 else values)


def test_endovis_2017_has_a_folder_per_tool_and_parts_as_values(sequence: Sequence, tmp_path: Path) -> None:
    truth = tmp_path / "ground_truth"
    first, second = np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    first[:10], first[10:20], second[30:40] = 10, 20, 30
    write_png(truth / "Large_Needle_Driver_Left_labels" / "frame001.png", first)
    write_png(truth / "Prograsp_Forceps_labels" / "frame001.png", second)
    (tmp_path / "mappings.json").write_text(json.dumps({"Shaft": 10, "Wrist": 20, "Claspers": 30}))
    frames, labels, _ = all_of(truth, sequence, "left")
    found = frames[0, "left"].labels
    named = {labels[value - 1]: int((found == value).sum()) for value in np.unique(found) if value}
    tool = "Large_Needle_Driver_Left"
    assert named == {f"{tool}.Shaft": 960, f"{tool}.Wrist": 960, "Prograsp_Forceps.Claspers": 960}


def test_endovis_2018_has_colours_of_which_those_of_instruments_are_kept(sequence: Sequence, tmp_path: Path) -> None:
    meaning = [
        {"name": "background-tissue", "color": [0, 0, 0], "classid": 0},
        {"name": "instrument-shaft", "color": [0, 255, 0], "classid": 1},
        {"name": "kidney-parenchyma", "color": [0, 255, 255], "classid": 4},
    ]
    (tmp_path / "seq_1").mkdir()
    (tmp_path / "seq_1" / "labels.json").write_text(json.dumps(meaning))
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:8], image[20:30] = (0, 255, 0), (0, 255, 255)
    write_png(tmp_path / "seq_1" / "labels" / "frame002.png", image)
    frames, labels, _ = all_of(tmp_path / "seq_1" / "labels", sequence, "right")
    assert labels == ["instrument-shaft"] and (frames[1, "right"].labels > 0).sum() == 8 * WIDTH
    image[60:] = (1, 2, 3)
    write_png(tmp_path / "seq_1" / "labels" / "frame002.png", image)
    with pytest.raises(SequenceError, match=r"has the colour #010203, which labels.json does not list"):
        all_of(tmp_path / "seq_1" / "labels", sequence, "right")


def test_masks_in_folders_called_left_and_right_find_their_cameras(sequence: Sequence, tmp_path: Path) -> None:
    for side in ("left", "right"):
        for number in (1, 2, 9):
            write_png(tmp_path / "marked" / f"{side}_frames" / f"img{number:05d}.png", disc(number) * np.uint8(255))
    frames, labels, unknown = all_of(tmp_path / "marked", sequence)
    assert set(frames) == {(0, "left"), (0, "right"), (1, "left"), (1, "right")} and labels == ["instrument"]
    assert np.array_equal(frames[1, "right"].labels > 0, disc(2)) and len(unknown) == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((10, 12), np.uint8), "is 12 x 10 pixels, but images of camera 'left' are 96 x 72"),
        (np.full((HEIGHT, WIDTH, 3), (1, 2, 3), np.uint8), "have a labels.json that names them"),
    ],
)
def test_masks_of_other_sizes_are_refused(sequence: Sequence, tmp_path: Path, values: np.ndarray, message: str) -> None:
    write_png(tmp_path / "left" / "001.png", values)
    with pytest.raises(SequenceError, match=message):
        all_of(tmp_path / "left", sequence)


def test_a_damaged_mask_and_a_folder_without_masks_are_refused(sequence: Sequence, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(SequenceError, match=r"has no masks \(.png, .bmp, .tif"):
        all_of(tmp_path / "none", sequence)
    write_png(tmp_path / "left" / "001.png", disc(1) * np.uint8(255))
    file = tmp_path / "left" / "001.png"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(SequenceError, match=r"001\.png is damaged"):
        all_of(tmp_path / "left", sequence)
    with pytest.raises(SequenceError, match=r"nothing\.txt is missing"):
        all_of(tmp_path / "nothing.txt", sequence)
    (tmp_path / "nothing.txt").write_text("no masks")
    with pytest.raises(SequenceError, match="has no masks or keypoints in a supported format"):
        all_of(tmp_path / "nothing.txt", sequence)


def test_links_are_left_out_where_nothing_outside_may_be_read(sequence: Sequence, tmp_path: Path) -> None:
    write_png(tmp_path / "elsewhere.png", disc(1) * np.uint8(255))
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "001.png").symlink_to(tmp_path / "elsewhere.png")
    assert len(list(read_annotations(tmp_path / "left", sequence).frames)) == 1
    with pytest.raises(SequenceError, match="has no masks"):
        list(read_annotations(tmp_path / "left", sequence, confined=True).frames)


def test_keypoints_of_surgpose_have_pixel_centres_at_a_half(sequence: Sequence, tmp_path: Path) -> None:
    path = tmp_path / "keypoints_right.yaml"
    path.write_text("1:\n  1: [10.0, 20.5]\n  2: null\n2:\n  1: [11, 21]\n50: {1: [1, 1]}\n")
    frames, _, unknown = all_of(path, sequence)
    assert {at: found.keypoints for at, found in frames.items()} == {
        (0, "right"): {"1": (10.5, 21.0)},
        (1, "right"): {"1": (11.5, 21.5)},
    }
    assert frames[0, "right"].labels is None and len(unknown) == 1
    path.write_text("- 1\n- 2\n")
    with pytest.raises(SequenceError, match="has no keypoints in the format of SurgPose"):
        all_of(path, sequence)


def test_what_was_marked_in_images_with_distortion_is_undistorted(tiny_sequence: Callable[..., Path], tmp_path: Path):
    lens = [-0.3, 0.1, 0.001, -0.002]
    path = tiny_sequence(masks=False, edit=lambda text: text + f"distortion = {lens}\n")
    sequence = Sequence.open(path)
    camera: Camera = sequence.recorded_camera("left")
    write_png(tmp_path / "marked" / "left" / "001.png", disc(3) * np.uint8(255))
    frames, _, _ = all_of(tmp_path / "marked", sequence)
    assert np.array_equal(frames[0, "left"].labels > 0, camera.undistort(disc(3)))
    points = tmp_path / "keypoints_left.yaml"
    points.write_text("1: {1: [20, 60]}\n")
    (u, v) = all_of(points, sequence)[0][0, "left"].keypoints["1"]
    spot = np.zeros((HEIGHT, WIDTH), np.float32)
    spot[60, 20] = 1.0
    rows, columns = np.nonzero(camera.undistort(cv2.GaussianBlur(spot, (0, 0), 1.0)) > 0.05)
    assert abs(columns.mean() + 0.5 - u) < 0.6 and abs(rows.mean() + 0.5 - v) < 0.6


def test_points_in_corners_of_strongly_distorted_images_are_undistorted(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    lens = [-0.9, 0.6, 0.0, 0.0]
    path = tiny_sequence(masks=False, edit=lambda text: text + f"distortion = {lens}\n")
    sequence = Sequence.open(path)
    camera: Camera = sequence.recorded_camera("left")
    points = tmp_path / "keypoints_left.yaml"
    points.write_text("1: {1: [1, 2]}\n")
    found = np.array(all_of(points, sequence)[0][0, "left"].keypoints["1"])
    ray = np.append((found - camera.K[:2, 2]) / camera.K[0, 0], 1.0)
    back, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), camera.K_opencv, np.array(lens))
    np.testing.assert_allclose(back.ravel(), (1, 2), atol=1e-3)


LENS = "distortion = [-0.3, 0.1, 0.001, -0.002]\n"


@pytest.fixture
def distorted(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(masks=False, edit=lambda text: text + LENS))


def test_corrected_labels_of_an_export_are_not_undistorted_twice(distorted: Sequence, tmp_path: Path) -> None:
    dataset = Dataset(distorted, tuple(measured_frames(distorted, range(1))), distorted.scene, "regular")
    file = export(dataset, "coco", tmp_path / "exported") / "annotations" / "instances_default.json"
    elsewhere = tmp_path / "downloads" / "instances.json"
    elsewhere.parent.mkdir()
    elsewhere.write_bytes(file.read_bytes())
    found = read_annotations(file, distorted)
    (exported,) = found.frames
    assert exported.labels is not None and exported.labels.any()
    assert "are assumed to be drawn on undistorted images, as in this export" in " ".join(found.remarks)
    found = read_annotations(elsewhere, distorted, drawn_on="undistorted")
    (corrected,) = found.frames
    assert corrected.labels is not None and np.array_equal(corrected.labels, exported.labels) and not found.remarks
    found = read_annotations(elsewhere, distorted)
    (assumed,) = found.frames
    camera = distorted.recorded_camera("left")
    assert assumed.labels is not None
    assert np.array_equal(assumed.labels, camera.undistort(exported.labels, cv2.INTER_NEAREST))
    assert "drawn on recorded images. If" in " ".join(found.remarks)
    assert "--drawn-on undistorted" in " ".join(found.remarks)


@pytest.mark.parametrize(
    ("content", "folder", "recorded"),
    [
        ('{"format": "surgsync"}', "annotation/carts_mask", True),
        ('{"format": "recorded-csv"}', "carts_mask", True),
        ('{"format": "recorded-csv"}', "rendered", False),
        ('{"format": "masks"}', "binary", False),
        ('{"format": "sequence"}', "theirs", True),
        ("damaged", "theirs", True),
    ],
)
def test_masks_in_exports_are_undistorted_as_their_format_requires(
    distorted: Sequence, tmp_path: Path, content: str, folder: str, recorded: bool
) -> None:
    place = tmp_path / "exported" / folder
    write_png(place / "left" / "001.png", disc(3) * np.uint8(255))
    (tmp_path / "exported" / "export.json").write_text(content)
    for confined in (False, True):
        found = read_annotations(place, distorted, confined=confined)
        (frame,) = found.frames
        assert frame.labels is not None
        wanted = distorted.recorded_camera("left").undistort(disc(3)) if recorded else disc(3)
        assert np.array_equal(frame.labels > 0, wanted)
        assert f"drawn on {'recorded' if recorded else 'undistorted'} images" in next(iter(found.remarks))


def test_cameras_without_distortion_need_no_remark(sequence: Sequence, tmp_path: Path) -> None:
    write_png(tmp_path / "left" / "001.png", disc(3) * np.uint8(255))
    found = read_annotations(tmp_path / "left", sequence)
    assert len(list(found.frames)) == 1 and not found.remarks


@pytest.mark.parametrize(
    ("names", "frames"),
    [
        (["img1_inst1", "img1_inst2", "img2_inst1", "img3_inst1"], [0, 0, 1, 2]),
        (["frame_002_mask0", "frame_003_mask0"], [1, 2]),
        (["tool1_frame001", "tool2_frame001"], [0, 0]),
        (["2024_seq7_1", "2024_seq7_3"], [0, 2]),
        (["img900_mask1", "img901_mask1"], []),
        (["seq_001_frame3"], [2]),
    ],
)
def test_the_frame_number_is_found_beside_numbers_of_instances(
    sequence: Sequence, tmp_path: Path, names: list[str], frames: list[int]
) -> None:
    for number, name in enumerate(names):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[10 * number : 10 * number + 10] = 255
        write_png(tmp_path / "left" / f"{name}.png", mask)
    found, _, unknown = all_of(tmp_path / "left", sequence)
    assert {at for at, _ in found} == set(frames) and len(unknown) == len(names) - len(frames)
    for number, frame in enumerate(frames):
        assert (found[frame, "left"].labels[10 * number : 10 * number + 10] > 0).all()


def test_a_frame_number_before_another_number_is_remarked(sequence: Sequence, tmp_path: Path) -> None:
    for name in ("img2_inst1", "img3_inst1"):
        write_png(tmp_path / "left" / f"{name}.png", disc(3) * np.uint8(255))
    found = read_annotations(tmp_path / "left", sequence)
    assert len(list(found.frames)) == 2
    assert list(found.remarks) == ["the frame number is 2 in names such as img2_inst1"]


def test_a_padded_id_is_the_frame_number_even_in_one_name(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    path = tiny_sequence(masks=False, edit=lambda text: text.replace("{frame:03d}", "{frame:06d}"))
    for image in (path.parent / "regular" / "left").iterdir():
        image.rename(image.with_name(f"000{image.name}"))
    sequence = Sequence.open(path)
    assert sequence.frame_ids[1] == "000002"
    for name in ("frame_000002_mask0", "frame_000002_mask1"):
        write_png(tmp_path / "theirs" / f"{name}.png", disc(3) * np.uint8(255))
        frames, _, _ = all_of(tmp_path / "theirs", sequence)
        assert [*frames] == [(1, "left")]


def test_ambiguous_frame_numbers_are_refused(sequence: Sequence, tmp_path: Path) -> None:
    for name in ("a1_b1", "a1_b2", "a2_b1", "a2_b2"):
        write_png(tmp_path / "left" / f"{name}.png", disc(3) * np.uint8(255))
    with pytest.raises(SequenceError, match=r"which number in a1_b1, a1_b2 \.\.\. .* such as 001\."):
        all_of(tmp_path / "left", sequence)


@pytest.mark.parametrize(
    ("numbers", "remarked"), [((1, 2, 3), True), ((3,), True), ((0, 1, 2), False), ((2,), False), ((0, 3), False)]
)
def test_images_of_a_video_that_are_numbered_from_one_are_remarked(
    tiny_sequence: Callable[..., Path], tmp_path: Path, numbers: tuple[int, ...], remarked: bool
) -> None:
    images = tmp_path / "recording" / "left.mp4"
    images.parent.mkdir()
    write_video(images, [np.full((HEIGHT, WIDTH, 3), 60, np.uint8)] * 3, milliseconds=np.array([0, 100, 200]))

    def as_video(text: str) -> str:
        text = text.replace('"{domain}/{camera}/{frame}.png"', f'"{images}"').replace('frame_id = "{frame:03d}"\n', "")
        return text.replace("[kinematics]", f'[frames]\nframe_id = "{{frame:06d}}"\nvideo = "{images}"\n[kinematics]')

    sequence = Sequence.open(tiny_sequence(masks=False, truth=False, edit=as_video))
    assert int(sequence.frame_ids[0]) == 0 and len(sequence) == 3
    for number in numbers:
        write_png(tmp_path / "theirs" / f"{number:06d}.png", disc(3) * np.uint8(255))
    found = read_annotations(tmp_path / "theirs", sequence)
    list(found.frames)
    assert any("are numbered from 0" in remark and "-start_number 0" in remark for remark in found.remarks) == remarked
