"""The start page: what may be looked into, what was opened lately, and half-made imports."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from carts_core.errors import SettingsError
from carts_core.optimization.hand_eye import ImagePoint
from carts_core.project import JointCorrection, Key, Project, Provenance, Review, ReviewState, Source
from carts_core.project.identity import data_dir
from carts_core.recording import Sequence
from carts_core.settings.interchange import ImportOptions
from carts_viewer.actions import intents
from carts_viewer.start.roots import Roots
from carts_viewer.start.site import Site
from carts_viewer.start.start_page import StartPage, forget, recent_projects, thumbnail
from carts_viewer.transport.document import escaped, render
from carts_viewer.wizard.draft import Draft, DraftFile, Step, delete_draft, drafts
from carts_viewer.wizard.wizard import RecordingWizard


@pytest.fixture
def roots(tmp_path: Path) -> Roots:
    (tmp_path / "allowed" / "inner").mkdir(parents=True)
    (tmp_path / "allowed" / "inner" / "a.toml").write_text("x")
    (tmp_path / "allowed" / ".hidden").mkdir()
    (tmp_path / "allowed" / ".hidden" / "b.toml").write_text("x")
    (tmp_path / "allowed" / "inner" / ".c.toml").write_text("x")
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "s.toml").write_text("x")
    (tmp_path / "allowed" / "out").symlink_to(tmp_path / "secret")
    (tmp_path / "allowed" / "inner" / "s.toml").symlink_to(tmp_path / "secret" / "s.toml")
    os.mkfifo(tmp_path / "allowed" / "pipe")
    return Roots([tmp_path / "allowed"])


def test_folders_and_files_below_a_root_are_listed_without_links_pipes_and_hidden_ones(roots: Roots) -> None:
    root = roots.folders[0]
    assert [(entry.name, entry.is_folder) for entry in roots.entries(root)] == [("inner", True)]
    assert [entry.name for entry in roots.entries(root / "inner")] == ["a.toml"]
    assert roots.parent(root / "inner") == root and roots.parent(root) is None


@pytest.mark.parametrize(
    "path",
    [
        "{root}/../secret/s.toml",
        "{root}/inner/../../secret",
        "{root}/out/s.toml",
        "{root}/out",
        "{root}/inner/s.toml",
        "{root}/pipe",
        "{root}/nothing",
        "{root}/.hidden",
        "{root}/.hidden/b.toml",
        "{root}/inner/.c.toml",
        "{root}x",
        "/etc/passwd",
        "inner",
        "",
        "{root}/inner\x00",
        "/",
    ],
)
def test_nothing_outside_of_the_roots_can_be_reached(roots: Roots, path: str) -> None:
    with pytest.raises(SettingsError):
        roots.checked(path.replace("{root}", str(roots.folders[0])))


def test_a_root_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"--root .*nothing is no folder"):
        Roots([tmp_path / "nothing"])


def test_a_root_that_is_a_link_itself_is_what_the_person_named(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.csv").write_text("x")
    (tmp_path / "named").symlink_to(tmp_path / "real")
    roots = Roots([tmp_path / "named"])
    assert [entry.name for entry in roots.entries(roots.folders[0])] == ["a.csv"]


@pytest.fixture
def site(tmp_path: Path) -> Site:
    (tmp_path / "labs").mkdir(exist_ok=True)
    return Site([tmp_path / "labs"], port=0)


def test_a_sequence_is_opened_left_and_remembered_with_its_picture(
    site: Site, tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    with site:
        site.wait()
        assert isinstance(site.shown, StartPage) and recent_projects() == []
        path = tiny_sequence(frames=3)
        site.post(lambda: site.open_sequence(path))
        site.wait(120)
        assert site.app is not None and site.shown is None
        assert [project.sequence for project in recent_projects()] == [str(path)]
        site.post(site.show_start)
        site.wait(120)
        assert site.app is None and isinstance(site.shown, StartPage)
        project = recent_projects()[0]
        assert (project.name, project.frames, project.reviewed, project.corrected) == ("tiny", 3, 0, 0)
        assert (thumbnail(project) or b"")[:2] == b"\xff\xd8"
        # The same server opens it again, and the project is not held any more.
        site.post(lambda: site.open_sequence(path))
        site.wait(120)
        assert site.app is not None and site.app.notice is None
    assert site.incident is None
    path.unlink()
    assert recent_projects() == []


def test_a_card_has_the_numbers_of_its_project_whatever_program_changed_it(
    site: Site, tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    def card() -> str:
        site.post(site.show_start)
        site.wait(120)
        return site.document.content

    path, other = tiny_sequence(frames=3), tmp_path / "labs" / "other.carts"
    with site:
        site.post(lambda: site.open_sequence(path, project=other))
        site.wait(120)
        assert site.app is not None
        # A note that is still under the hand is saved when the sequence is left.
        site.app.queue.put(intents.SetReview(ReviewState.ACCEPTED))
        site.app.queue.put(intents.SetNote("smoke"))
        assert "1 of 3 frames reviewed, 0 corrected" in card()
        solved = JointCorrection(
            (0.1,) * len(Sequence.open(path).scene.arms[0].robot.joint_names), Provenance(Source.HAND)
        )
        with Project.open(Sequence.open(path), other) as project:
            project.apply("Solve", {Key.joints(index, "PSM1"): solved for index in range(3)})
            project.apply("Accept", {Key.review(2): Review(ReviewState.REJECTED)})
            # Also while it is open elsewhere.
            assert "1 of 3 frames reviewed, 3 corrected" in card()
        assert "1 of 3 frames reviewed, 3 corrected" in card()
        place = site.shown
        assert place is not None
        site.post(lambda: place.choose("recent", str(path)))
        site.wait(120)
        assert site.app is not None and site.app.project.path == other
        site.post(site.show_start)
        site.wait(120)
        other.write_bytes(b"not a project")
        assert "Progress unknown" in card()
        other.unlink()
        assert "0 of 3 frames reviewed, 0 corrected" in card()


def test_a_sequence_that_cannot_be_opened_leads_back_with_the_reason(site: Site, tmp_path: Path) -> None:
    (tmp_path / "labs" / "bad.toml").write_text("format = 3")
    with site:
        site.post(lambda: site.open_sequence(tmp_path / "labs" / "bad.toml"))
        site.wait(120)
        assert isinstance(site.shown, StartPage) and site.app is None
        assert "bad.toml" in site.document.content and 'role="alert"' in site.document.content


def test_only_a_listed_recent_sequence_is_opened_by_its_card(site: Site, tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence(frames=2)
    with site:
        site.wait()
        assert site.shown is not None
        place = site.shown
        site.post(lambda: place.choose("recent", str(path)))
        site.post(lambda: place.choose("pick", str(path)))
        site.post(lambda: place.choose("nonsense", "x" * 100))
        site.wait()
        assert site.app is None and site.shown is place


def test_a_damaged_list_of_recent_sequences_is_an_empty_one(tmp_path: Path) -> None:
    folder = data_dir() / "recent"
    folder.mkdir(parents=True)
    for text in ("", "[1, 2]", '{"a": 1}', '[{"sequence": 3}]', "[" * 100_000, '[{"sequence": "a", "name": 1}]'):
        (folder / "recent.json").write_text(text)
        assert recent_projects() == []
    forget("x")
    assert recent_projects() == []


def test_a_draft_is_the_same_after_it_was_written_and_read() -> None:
    options = ImportOptions(
        images={"left": "/a/b"}, calibration={"left": Path("/a/l.yaml")}, kinematics=Path("/a/k.csv"), flip=("yaw",),
        columns={"yaw": "q1"}, angle_unit="deg", time_offset=0.25, robot={"PSM1": "/r.urdf"},
    )  # fmt: skip
    point = ImagePoint(3, "left", "PSM1", "tip", (1.5, 2.25))
    draft = Draft(Step.HAND_EYE, "/a", "name", options, (point,), True, {"arms": {"PSM1": [[1.0]]}})
    assert Draft.from_json(draft.to_json()) == draft


def test_drafts_are_listed_newest_first_and_damaged_ones_can_be_deleted(tmp_path: Path) -> None:
    assert drafts() == []
    first, second = DraftFile(), DraftFile()
    first.write(Draft(source="/a/first"))
    second.write(Draft(source="/a/second", name="named"))
    os.utime(data_dir() / "drafts" / f"{first.key}.json", (1, 1))
    assert [draft.name for draft in drafts()] == ["named", "first"]
    assert DraftFile(second.key).read().name == "named"
    (data_dir() / "drafts" / "bad.json").write_text("{")
    assert "a damaged import" in {draft.name for draft in drafts()}
    with pytest.raises(SettingsError, match="cannot be gone on with"):
        DraftFile("bad").read()
    for key in ("bad", "../../x", first.key):
        delete_draft(key)
    assert [draft.name for draft in drafts()] == ["named"]
    with pytest.raises(SettingsError, match="not there any more"):
        DraftFile("../../x")


def test_an_import_that_was_begun_is_gone_on_with_by_another_server(site: Site, tmp_path: Path) -> None:
    (tmp_path / "labs" / "rec").mkdir()
    with site:
        site.post(site.show_recording)
        site.wait()
        place = site.shown
        assert isinstance(place, RecordingWizard)
        site.post(lambda: place.choose("pick", str(tmp_path / "labs" / "rec")))
        site.wait()
        assert place.draft.step is Step.CHECK and 'role="alert"' in site.document.content
    with Site([tmp_path / "labs"], port=0) as again:
        again.wait()
        key = drafts()[0].key
        assert again.shown is not None
        start = again.shown
        again.post(lambda: start.choose("draft", key))
        again.wait()
        assert isinstance(again.shown, RecordingWizard) and again.shown.draft == place.draft
        resumed = again.shown
        again.post(lambda: resumed.choose("delete", ""))
        again.wait()
        assert drafts() == [] and isinstance(again.shown, StartPage)


def test_what_is_foreign_is_escaped_in_documents() -> None:
    nasty = "<img src=x onerror=alert(1)>\"'&"
    for text in (escaped(nasty), render("message.html", title=nasty, text=nasty)):
        assert "<img" not in text and "onerror=alert(1)>" not in text and "\"'&" not in text
