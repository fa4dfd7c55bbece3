"""Data sets of exports: labels, images and cancellation."""

import json
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from awkward import ARMS, CAMERA, all_views
from tiny import recorded_mask

from carts_core.errors import CartsError, SequenceError, SettingsError
from carts_core.export import (
    FORMATS,
    Dataset,
    ExportCancelled,
    ExportProgress,
    FormatName,
    KinematicsRow,
    corrected_frames,
    export,
    measured_frames,
    network_refiner,
    project_frame,
)
from carts_core.export.dataset import labelled
from carts_core.files import file_name, unique_file_names
from carts_core.model.parts import part_classes
from carts_core.model.scene import SceneState
from carts_core.networks import FeatureExtractor
from carts_core.project import Key, MaskCorrection, Project
from carts_core.recording import Sequence
from carts_core.recording.images import read_mask
from carts_core.rendering import Renderer


def test_masks_of_measured_frames_are_those_of_the_renderer(dataset: Dataset) -> None:
    frame = dataset.frames[0]
    arm_ids = Renderer(dataset.scene).segment(dataset.scene.state(frame.joint_positions))[0]
    np.testing.assert_array_equal(dataset.label_image(all_views(dataset)[0]).astype(int) - 1, arm_ids)
    assert set(np.unique(arm_ids)) == {-1, 0, 1}, "the scene must show both arms"


@pytest.mark.parametrize("parts", ["links", "parts"])
def test_links_and_parts_of_an_arm_make_up_the_arm(dataset: Dataset, parts: Literal["links", "parts"]) -> None:
    view, divided = all_views(dataset)[0], replace(dataset, parts=parts)
    pieces = list(divided.instances(view))
    assert len(pieces) > len(ARMS) and all(category.name.startswith(f"{category.arm}.") for category, _ in pieces)
    for category, mask in dataset.instances(view):
        np.testing.assert_array_equal(
            np.sum([one for piece, one in pieces if piece.arm == category.name], axis=0), mask
        )


@pytest.fixture
def distorted(tiny_sequence: Callable[..., Path]) -> Dataset:
    """Data set of one frame, in which the arm crosses the border of a strongly distorted image."""
    path = tiny_sequence(frames=1, edit=lambda text: text + "distortion = [-0.7, 0.4, 0.0, 0.0]\n")
    sequence = Sequence.open(path)
    return Dataset(sequence, tuple(measured_frames(sequence, [0])), sequence.scene, "regular")


def test_the_mask_of_a_distorted_recording_reaches_the_border(distorted: Dataset) -> None:
    (view,) = distorted.views(ExportProgress())
    camera, mask = distorted.sequence.recorded_camera("left"), distorted.recorded_mask(view)
    expected = recorded_mask(distorted.scene, distorted.state(view.frame), camera)
    assert (mask != expected).sum() <= 3 and mask.shape == expected.shape
    assert (expected & ~camera.distorted_mask(view.link_ids >= 0)).sum() > 15


def test_corrections_at_the_border_continue_in_a_distorted_recording(distorted: Dataset) -> None:
    (view,) = distorted.views(ExportProgress())
    rendered, before = view.link_ids >= 0, distorted.recorded_mask(view)
    painted = rendered.copy()
    assert not rendered[:, 0].any() or not rendered[:, -1].any()
    own = 0 if not rendered[:, 0].any() else -1
    painted[:, own] = True
    (frame,) = distorted.frames
    changed = replace(distorted, frames=(replace(frame, masks={"left": painted}),))
    (view,) = changed.views(ExportProgress())
    after = changed.recorded_mask(view)
    assert view.mask == "painted" and after[:, own].all()
    opposite = slice(0, 40) if own == -1 else slice(-40, None)
    assert np.array_equal(after[:, opposite], before[:, opposite])


def test_a_corrected_mask_decides_where_arms_are_and_the_rendering_whose_they_are(dataset: Dataset) -> None:
    view = all_views(dataset)[2]
    mask = dataset.frames[2].masks[CAMERA]
    np.testing.assert_array_equal(view.link_ids >= 0, mask)
    rendered = all_views(replace(dataset, frames=tuple(replace(frame, masks={}) for frame in dataset.frames)))[2]
    both = mask & (rendered.link_ids >= 0)
    np.testing.assert_array_equal(view.link_ids[both], rendered.link_ids[both])


def test_added_pixels_get_the_nearest_label() -> None:
    rendered = np.array([[3, -1, -1, -1, -1, 7]])
    np.testing.assert_array_equal(
        labelled(np.array([[False, True, True, False, True, True]]), rendered, "here"), [[-1, 3, 3, -1, 7, 7]]
    )


def test_pixels_that_nothing_rendered_explains_are_an_error() -> None:
    with pytest.raises(CartsError, match="here: the mask has 2 pixels, but no arm is in view"):
        labelled(np.array([[True, True]]), np.array([[-1, -1]]), "here")


@pytest.mark.parametrize("mask", [np.zeros((2, 2), bool), np.zeros((1, 2), np.uint8)])
def test_a_mask_of_another_size_or_kind_is_an_error(mask: np.ndarray) -> None:
    with pytest.raises(CartsError, match=r"here: the mask is .*Give a Boolean mask"):
        labelled(mask, np.array([[-1, -1]]), "here")


def test_a_painted_mask_is_rendered_once_for_each_view(sequence: Sequence, tmp_path: Path) -> None:
    rendered, nothing = [], np.zeros((127, 161), bool)

    def render(pose: SceneState, camera: str) -> np.ndarray:
        rendered.append(camera)
        return nothing

    with Project.open(sequence, tmp_path / "painted.carts") as project:
        project.apply("Paint", {Key.mask_correction(1, CAMERA): MaskCorrection.of(nothing, nothing)})
        frame = project_frame(sequence, project.state, 1, [CAMERA], render)
    painted = Dataset(sequence, (frame,), sequence.scene, "regular")
    assert [view.mask for view in all_views(painted)] == ["painted"] and rendered == [CAMERA]


def test_names_are_safe_and_unique(dataset: Dataset) -> None:
    assert [name for name, _, _ in dataset.steps] == [f"linke_Kamera_ü_Bild_{n}_ä" for n in (1, 2, 3)]
    assert unique_file_names(["a b", "a_b", "A/B", "..", ""]) == ["a_b", "a_b-2", "A_B-3", "_", "_-2"]
    assert file_name("../../etc/passwd") == "_.._etc_passwd"


def test_an_export_of_no_frames_is_refused(sequence: Sequence) -> None:
    with pytest.raises(SettingsError, match="no frame to export"):
        Dataset(sequence, (), sequence.scene, "regular")


def test_masks_of_an_unknown_camera_are_refused(dataset: Dataset) -> None:
    frame = replace(dataset.frames[0], masks={"middle": np.zeros((127, 161), bool)})
    with pytest.raises(SettingsError, match=r"masks were given for cameras middle, which are not in"):
        replace(dataset, frames=(frame,))


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), 1e9])
def test_an_impossible_frame_rate_is_refused(sequence: Sequence, rate: float) -> None:
    with pytest.raises(SettingsError, match="frame rate"):
        Dataset(sequence, tuple(measured_frames(sequence, [0])), sequence.scene, "regular", frame_rate=rate)


def test_rows_of_unknown_or_repeated_frames_are_refused(sequence: Sequence) -> None:
    row = KinematicsRow(sequence.frame_ids[0], "optimized", {})
    with pytest.raises(SequenceError, match="twice"):
        corrected_frames(sequence, range(3), [row, row])
    with pytest.raises(SequenceError, match=r"'999', which is not in"):
        corrected_frames(sequence, range(3), [replace(row, frame_id="999")])


def test_a_painted_class_belongs_to_its_part_whatever_is_rendered_there(dataset: Dataset) -> None:
    wanted = part_classes(dataset.scene.arms)[2]
    assert wanted.part == "jaws"
    painted = np.zeros((127, 161), np.uint8)
    painted[40:50, 30:60] = wanted.number
    frames = tuple(replace(frame, part_labels={CAMERA: painted}) for frame in dataset.frames)
    for before, view in zip(all_views(dataset), all_views(replace(dataset, frames=frames)), strict=True):
        by_part = dataset.label_image(view, "parts")
        category = next(one for one in dataset.categories_of("parts") if one.name == f"{wanted.arm}.jaws")
        assert (by_part[painted > 0] == category.id).all()
        elsewhere = painted == 0
        np.testing.assert_array_equal(view.link_ids[elsewhere], before.link_ids[elsewhere])


def test_a_painted_class_that_no_link_has_is_refused(dataset: Dataset) -> None:
    painted = np.full((127, 161), 99, np.uint8)
    frame = replace(dataset.frames[0], part_labels={CAMERA: painted})
    with pytest.raises(CartsError, match="painted class 99"):
        all_views(replace(dataset, frames=(frame,)))


@pytest.mark.parametrize("name", [name for name, known in FORMATS.items() if not known.source])
def test_a_cancelled_export_leaves_nothing(dataset: Dataset, name: FormatName, tmp_path: Path) -> None:
    cancel, steps = threading.Event(), []

    def progress(done: int, total: int) -> None:
        steps.append((done, total))
        cancel.set()

    folder = tmp_path / "exports"
    folder.mkdir()
    with pytest.raises(ExportCancelled):
        export(dataset, name, folder / "out", progress=ExportProgress(progress, cancel.is_set))
    assert steps == [(1, len(dataset.scene.arms) if name.startswith("dvrk") else 3)]
    assert os.listdir(folder) == []


def test_masks_of_good_frames_are_refined_with_the_rendered_ones_beside_them(
    sample_sequence_path: Path, tmp_path: Path
) -> None:
    sequence = Sequence.open(sample_sequence_path)
    first, second, third = measured_frames(sequence, range(3))
    scene = sequence.scene.with_cameras(["left"])
    camera = scene.cameras[0]
    given = {"left": np.zeros((camera.height, camera.width), bool)}
    frames = (replace(first, verdict="good"), replace(second, verdict="doubtful"), replace(third, verdict="good"))
    frames = (*frames[:2], replace(frames[2], masks=given))
    rendered = Dataset(sequence, frames, scene, "regular")
    dataset = replace(rendered, masks="auto", refine=network_refiner(FeatureExtractor.load))
    folders = [export(each, "masks", tmp_path / str(number)) for number, each in enumerate((rendered, dataset))]
    sources = [view["mask"] for view in json.loads((folders[1] / "export.json").read_text())["views"]]
    assert sources == ["refined", "rendered", "painted"]
    name = all_views(rendered)[0].name
    before, after = (read_mask(folder / "binary" / f"{name}.png") for folder in folders)
    assert 0 < (before != after).mean() < 0.02
    (beside,) = (folders[1] / "rendered").iterdir()
    assert beside.name == f"{name}.png"
    np.testing.assert_array_equal(read_mask(beside), before)
    poses = export(dataset, "bop", tmp_path / "bop")
    sources = [view["mask"] for view in json.loads((poses / "export.json").read_text())["views"]]
    assert sources == ["rendered", "rendered", "painted"]
