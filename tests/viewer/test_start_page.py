"""The start page and a batch: allowed folders, recent recordings, half-made imports, and jobs that were done."""

import html
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from cut_off import hardly_legible
from playwright.sync_api import Browser, expect
from viewer_tab import READY, new_context
from waiting import eventually, wait_in

from carts_core.batch.folder import JOB_FILE, is_batch, known_jobs, read_jobs, write_jobs
from carts_core.batch.manifest import read_manifest
from carts_core.batch.results import review_project
from carts_core.cli.batch_job import BatchWork
from carts_core.errors import CartsError, SettingsError
from carts_core.files import output_path
from carts_core.project import JointCorrection, Key, Project, Provenance, Review, ReviewState, Source
from carts_core.project.identity import data_dir
from carts_core.recording import Sequence
from carts_core.settings.interchange import ImportOptions
from carts_viewer.actions import intents
from carts_viewer.start.roots import MAX_ENTRIES, Roots
from carts_viewer.start.site import Site
from carts_viewer.start.start_page import StartPage, recent_projects, thumbnail
from carts_viewer.transport.document import escaped, render
from carts_viewer.transport.events import Chosen
from carts_viewer.wizard.draft import ClickedPoint, Draft, DraftFile, Step, delete_draft, drafts
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


def test_nothing_outside_of_the_roots_can_be_reached(roots: Roots) -> None:
    root = str(roots.folders[0])
    inside = ("/../secret/s.toml", "/inner/../../secret", "/out/s.toml", "/out", "/inner/s.toml", "/pipe", "/nothing")
    hidden = ("/.hidden", "/.hidden/b.toml", "/inner/.c.toml", "x", "/inner\x00")
    for path in (*(root + path for path in (*inside, *hidden)), "/etc/passwd", "inner", "", "/"):
        with pytest.raises(SettingsError):
            roots.checked(path)


def test_a_folder_given_by_a_link_is_reached_by_the_path_of_the_link(roots: Roots, tmp_path: Path) -> None:
    real, link = roots.folders[0], tmp_path / "link"
    link.symlink_to(real)
    linked = Roots([tmp_path, link])
    assert linked.checked(link / "inner") == linked.checked(real / "inner") == real / "inner"
    for path in (link / "out", link / "inner" / "s.toml", link / ".." / "secret"):
        with pytest.raises(SettingsError):
            linked.checked(path)
    with pytest.raises(SettingsError, match="not an absolute path"):
        linked.checked("inner")


def test_a_long_list_keeps_folders_and_wanted_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "z").mkdir()
    for name in ("z.csv", *(f"{number:04d}.png" for number in range(MAX_ENTRIES + 100))):
        (tmp_path / name).touch()
    scanned = os.scandir

    @contextmanager
    def images_first(path: Path) -> Iterator[list[os.DirEntry[str]]]:
        with scanned(path) as listing:
            yield sorted(listing, key=lambda each: each.name)

    monkeypatch.setattr(os, "scandir", images_first)
    listed = Roots([tmp_path]).entries(tmp_path, lambda entry: entry.path.suffix == ".csv")
    names = [entry.name for entry in listed]
    assert len(names) == MAX_ENTRIES and (names[:2], names[-1]) == (["z", "0000.png"], "z.csv")
    assert listed[-1].about.startswith("0 B")


def test_a_root_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"--root .*nothing is not a folder"):
        Roots([tmp_path / "nothing"])


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
        site.wait()
        assert site.app is not None and site.shown is None
        assert [project.sequence for project in recent_projects()] == [str(path)]
        site.post(site.show_start)
        site.wait()
        assert site.app is None and isinstance(site.shown, StartPage)
        project = recent_projects()[0]
        assert (project.name, project.frames, project.reviewed, project.corrected) == ("tiny", 3, 0, 0)
        assert (thumbnail(project) or b"")[:2] == b"\xff\xd8"
        # The same server opens it again, and the project is not held any more.
        site.post(lambda: site.open_sequence(path))
        site.wait()
        assert site.app is not None and site.app.notice is None
    assert site.storage_failure is None
    path.unlink()
    assert recent_projects() == []


def test_a_card_has_the_numbers_of_its_project_whatever_program_changed_it(
    site: Site, tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    def card() -> str:
        site.post(site.show_start)
        site.wait()
        return site.document.content

    path, other = tiny_sequence(frames=3), tmp_path / "labs" / "other.carts"
    with site:
        site.post(lambda: site.open_sequence(path, project=other))
        site.wait()
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
        site.wait()
        assert site.app is not None and site.app.project.path == other
        site.post(site.show_start)
        site.wait()
        other.write_bytes(b"not a project")
        assert "Progress unknown" in card()
        other.unlink()
        assert "0 of 3 frames reviewed, 0 corrected" in card()


def test_a_sequence_that_cannot_be_opened_leads_back_with_the_reason(site: Site, tmp_path: Path) -> None:
    (tmp_path / "labs" / "bad.toml").write_text("format = 3")
    with site:
        site.post(lambda: site.open_sequence(tmp_path / "labs" / "bad.toml"))
        site.wait()
        assert isinstance(site.shown, StartPage) and site.app is None
        assert "bad.toml" in site.document.content and 'role="alert"' in site.document.content


def test_the_start_page_works_after_a_page_that_cannot_be_made(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("not a folder")
    with site:
        site.wait()
        monkeypatch.setenv("CARTS_DATA", str(tmp_path / "file" / "data"))
        site.post(lambda: site._dispatch(Chosen("open-path", str(tmp_path / "labs"))))
        site.wait()
        assert isinstance(site.shown, StartPage) and 'role="alert"' in site.document.content
        site.post(lambda: site._dispatch(Chosen("open", "")))
        site.wait()
        assert 'aria-label="File browser"' in site.document.content


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


def test_a_draft_is_the_same_after_it_was_written_and_read() -> None:
    options = ImportOptions(
        images={"left": "/a/b"}, calibration={"left": Path("/a/l.yaml")}, kinematics=Path("/a/k.csv"), flip=("yaw",),
        columns={"yaw": "q1"}, angle_unit="deg", time_offset=0.25, robot={"PSM1": "/r.urdf"},
    )  # fmt: skip
    point = ClickedPoint(3, "left", "PSM1", "tip", (1.5, 2.25), "0003")
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
    assert "damaged import" in {draft.name for draft in drafts()}
    with pytest.raises(SettingsError, match="cannot be continued"):
        DraftFile("bad").read()
    for key in ("bad", "../../x", first.key):
        delete_draft(key)
    assert [draft.name for draft in drafts()] == ["named"]
    with pytest.raises(SettingsError, match="no longer exists"):
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


def test_a_folder_whose_name_has_a_format_character_can_be_chosen(tmp_path: Path) -> None:
    folder = tmp_path / "labs" / "می\u200cخ & co"
    folder.mkdir(parents=True)
    with Site([tmp_path / "labs"], port=0) as site:
        site.post(lambda: site._dispatch(Chosen("open-batch", "")))
        site.wait()
        # Shown names have visible characters only.
        assert "می\\u200cخ &amp; co/" in site.document.content
        (value,) = re.findall('data-do="browse" data-value="([^"]*می[^"]*)"', site.document.content)
        assert html.unescape(value) == str(folder)
        site.post(lambda: site._dispatch(Chosen("browse", html.unescape(value))))
        site.wait()
        assert 'role="alert"' not in site.document.content and "This folder is empty." in site.document.content


@pytest.mark.browser
def test_the_file_browser_is_scrolled_into_view_when_it_opens(site: Site, tmp_path: Path, browser: Browser) -> None:
    (tmp_path / "labs" / "day 3").mkdir()
    with site, closing(new_context(browser, (1280, 640))) as context:
        page = context.new_page()
        page.goto(site.url)
        opened = page.get_by_role("button", name="Open a sequence file …")
        opened.evaluate("button => button.click()")  # without the scrolling of Playwright
        expect(page.get_by_label("File browser")).to_be_in_viewport(ratio=0.99)
        page.locator("main").evaluate("main => main.scrollTo(0, 0)")
        page.get_by_role("button", name="day 3/").evaluate("button => button.click()")
        expect(page.get_by_text("This folder is empty.")).to_be_attached()
        assert page.locator("main").evaluate("main => main.scrollTop") == 0


def test_what_is_foreign_is_escaped_in_documents() -> None:
    nasty = "<img src=x onerror=alert(1)>\"'&"
    for text in (escaped(nasty), render("message.html", title=nasty, text=nasty)):
        assert "<img" not in text and "onerror=alert(1)>" not in text and "\"'&" not in text


# ---- A batch --------------------------------------------------------------------------------------------------------

NOTE_NOTES = """
new MutationObserver((changes) => {
  for (const node of changes.flatMap((change) => [...change.addedNodes])) {
    if (node.className === "carts-note") localStorage.setItem("noted", node.textContent);
  }
}).observe(document, { childList: true, subtree: true });
"""
"""Record the texts of short notes, which disappear automatically."""


@pytest.fixture(scope="module")
def done_batch(shared_sequence: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Batch with a finished and a failed job."""
    sequence = shared_sequence(frames=2)
    manifest = sequence.parent / "archive.toml"
    job = f'[[jobs]]\nrecordings = ["{sequence.name}"]\nsteps = ["optimize"]\n'
    options = '[jobs.options]\noptimize = ["--settings", "iterations=2", "--frames", "001,002"]\n'
    manifest.write_text(f'format = "carts-batch/1"\n{job}{options}{job}domains = ["foggy"]\n')
    jobs, folder = read_manifest(manifest), output_path(tmp_path_factory.mktemp("batches") / "batch")
    write_jobs(folder, jobs)
    assert [outcome.status for outcome in map(BatchWork(folder, inference="torch"), jobs)] == ["done", "failed"]
    return folder.path


@pytest.fixture
def batch(done_batch: Path, tmp_path: Path) -> Path:
    return shutil.copytree(done_batch, tmp_path / "batch")


@pytest.mark.browser
def test_failures_of_a_batch_come_first_and_a_frame_opens_with_what_was_found(batch: Path, browser: Browser) -> None:
    roots = [batch.parent, read_jobs(batch)[0].recording.parent]
    with Site(roots, port=0, batch=batch) as site, closing(new_context(browser)) as context:
        page = context.new_page()
        for window in ((390, 844), (1280, 800)):
            page.set_viewport_size({"width": window[0], "height": window[1]})
            page.goto(site.url)
            rows = page.locator(".jobs tbody tr")
            expect(rows).to_have_count(2)
            expect(rows.first).to_contain_text("domain 'foggy' is not in")
            expect(page.locator(".card img").first).to_be_visible()
            # No text is shortened, and none is a column of single letters.
            cut = "one => one.scrollWidth > one.clientWidth + 1"
            assert not any(text.evaluate(cut) for text in page.locator(".card b, .card small, .jobs td").all())
            box = page.locator(".jobs td").first.bounding_box()
            assert box is not None and box["width"] > 150 and box["height"] < 150
        for colour in ("rgb(20, 24, 27)", "rgb(248, 250, 252)"):
            expect(page.locator("main")).to_have_css("background-color", colour)
            assert hardly_legible(page, 4.5) == []
            page.get_by_role("button", name="Light or dark").click()
        state = batch / "jobs" / read_jobs(batch)[1].name / JOB_FILE
        state.write_text(state.read_text().replace("foggy", "misty"))
        page.reload()
        expect(rows.first).to_contain_text("domain 'misty' is not in")
        page.locator(".card", has_text="frame 002").get_by_role("button", name="Open").click()
        app = eventually(lambda: site.app)
        assert app is not None
        eventually(lambda: app.state.index, lambda index: index == 1, 60)
        assert app.state.verdict is not None and app.state.pose.source.value == "optimizer"
        assert app.project.path.parent == batch / "jobs" / read_jobs(batch)[0].name
        # A page that is closed while it loads may keep the browser waiting.
        wait_in(page, READY)


def test_new_results_get_a_project_of_their_own_and_what_was_reviewed_stays(batch: Path) -> None:
    job = read_jobs(batch)[0]
    folder = output_path(batch) / "jobs" / job.name
    first = review_project(folder, job)
    assert review_project(folder, job) == first
    (table,) = (folder / "optimize").path.glob("*/*/kinematics.csv")
    lines = table.read_text().splitlines()
    table.write_text("\n".join(lines[:-1]) + "\n")
    second = review_project(folder, job)
    assert second != first and first.exists()


def test_a_list_of_jobs_that_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    row = {"name": "x", "recording": "/r", "camera": "", "domain": "", "steps": []}
    for change in ({"name": "../x"}, {"recording": "r"}):
        content = {"format": "carts-batch-jobs/1", "jobs": [row | change]}
        (tmp_path / "batch.json").write_text(json.dumps(content))
        with pytest.raises(CartsError):
            read_jobs(tmp_path)


def test_a_recording_outside_of_the_allowed_folders_is_not_opened(batch: Path, tmp_path: Path) -> None:
    content = json.loads((batch / "batch.json").read_text())
    content["jobs"][0]["recording"] = "/etc/passwd"
    (batch / "batch.json").write_text(json.dumps(content))
    assert is_batch(batch) and len(known_jobs(output_path(batch), read_jobs(batch))) == 2
    with Site([batch.parent], port=0, batch=batch) as site:
        site.wait()
        place = site.shown
        assert place is not None
        site.post(lambda: site._dispatch(Chosen("review", content["jobs"][0]["name"])))
        site.wait()
        assert site.app is None and "outside of the allowed folders" in site.document.content


@pytest.mark.browser
def test_another_recording_in_the_same_tab_is_not_taken_for_a_wrong_link(
    tiny_sequence: Callable[..., Path], tmp_path: Path, browser: Browser
) -> None:
    first = tiny_sequence(frames=2, width=160, height=128)
    second = first.with_name("other.toml")
    second.write_text(first.read_text().replace('name = "tiny"', 'name = "other"', 1))
    with Site([tmp_path], port=0) as site:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(NOTE_NOTES)
        page.goto(site.url)  # and at once, before it is connected:
        for path, name in ((first, "tiny"), (second, "other")):
            site.post(lambda path=path: site.open_sequence(path))
            expect(page.locator(".carts-saved")).to_have_attribute("title", re.compile(rf"{path.stem}\.carts$"))
            wait_in(page, f"location.href.includes('project={name}')")
        assert page.evaluate("localStorage.getItem('noted')") is None
        page.close()
