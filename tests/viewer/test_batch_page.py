"""A batch in the page: failures first, and any job's frames open with what was found."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from cut_off import hardly_legible
from playwright.sync_api import Browser, expect
from viewer_canvas import eventually
from waiting import wait_in

from carts_core.batch.folder import is_batch, known_jobs, read_jobs, write_jobs
from carts_core.batch.manifest import read_manifest
from carts_core.batch.review import review_project
from carts_core.cli.batch_job import BatchWork
from carts_core.errors import CartsError
from carts_core.files import output_path
from carts_viewer.start.site import Site
from carts_viewer.transport.events import Chosen

NOTE_NOTES = """
new MutationObserver((changes) => {
  for (const node of changes.flatMap((change) => [...change.addedNodes])) {
    if (node.className === "carts-note") localStorage.setItem("noted", node.textContent);
  }
}).observe(document, { childList: true, subtree: true });
"""
"""Keeps what short notes say, which go away by themselves."""


@pytest.fixture
def batch(tiny_sequence: Callable[..., Path], tmp_path: Path) -> Path:
    """Of one job that is done and one that has failed."""
    sequence = tiny_sequence(frames=3, width=160, height=128)
    manifest = sequence.parent / "archive.toml"
    job = f'[[jobs]]\nrecordings = ["{sequence.name}"]\nsteps = ["optimize"]\n'
    options = '[jobs.options]\noptimize = ["--settings", "iterations=4", "--frames", "001,002"]\n'
    manifest.write_text(f'format = "carts-batch/1"\n{job}{options}{job}domains = ["foggy"]\n')
    jobs, folder = read_manifest(manifest), output_path(tmp_path / "batch")
    write_jobs(folder, jobs)
    assert [outcome.status for outcome in map(BatchWork(folder, inference="torch"), jobs)] == ["done", "failed"]
    return tmp_path / "batch"


@pytest.mark.browser
def test_failures_come_first_and_a_frame_opens_with_what_was_found(batch: Path, browser: Browser) -> None:
    with Site([batch.parent], port=0, batch=batch) as site:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(site.url)
        rows = page.locator(".jobs tbody tr")
        expect(rows).to_have_count(2)
        expect(rows.first).to_contain_text("domain 'foggy' is not in")
        expect(page.locator(".card img").first).to_be_visible()
        page.locator(".card", has_text="frame 002").get_by_role("button", name="Open").click()
        app = eventually(lambda: site.app, lambda app: app is not None, 60)
        assert app is not None
        eventually(lambda: app.state.index, lambda index: index == 1, 60)
        assert app.state.verdict is not None and app.state.pose.source.value == "optimizer"
        assert app.project.path.parent == batch / "jobs" / read_jobs(batch)[0].name
        # A page that is closed while it loads may keep the browser waiting.
        wait_in(page, "window.__viserMutable?.nodeRefFromName['/overlay']")
        page.close()


@pytest.mark.browser
@pytest.mark.parametrize("window", [(1280, 800), (390, 844)])
def test_jobs_and_pictures_are_legible_at_any_size_light_and_dark(
    batch: Path, browser: Browser, window: tuple[int, int]
) -> None:
    with Site([batch.parent], port=0, batch=batch) as site:
        page = browser.new_page(viewport={"width": window[0], "height": window[1]})
        page.goto(site.url)
        name = page.locator(".jobs td").first
        expect(page.locator(".card img").first).to_be_visible()
        for colour in ("rgb(20, 24, 27)", "rgb(248, 250, 252)", "rgb(20, 24, 27)"):
            assert page.locator("main").evaluate("one => getComputedStyle(one).backgroundColor") == colour
            assert hardly_legible(page, 4.5) == []
            page.get_by_role("button", name="Light or dark").click()
        # No text is shortened, and none is a column of single letters.
        cut = "one => one.scrollWidth > one.clientWidth + 1"
        assert not any(text.evaluate(cut) for text in page.locator(".card b, .card small, .jobs td").all())
        box = name.bounding_box()
        assert box is not None and box["width"] > 150 and box["height"] < 150
        page.close()


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


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        '{"format": "carts-batch-jobs/1", "jobs": [{}]}',
        '{"format": "carts-batch-jobs/1", "jobs": [{"name": "../x", "recording": "/r", "camera": "", "domain": "", '
        '"steps": []}]}',
        '{"format": "carts-batch-jobs/1", "jobs": [{"name": "x", "recording": "r", "camera": "", "domain": "", '
        '"steps": []}]}',
    ],
)
def test_a_list_of_jobs_that_is_damaged_or_leads_elsewhere_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "batch.json").write_text(content)
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
            expect(page.get_by_text(f"in {path.stem}.carts")).to_be_visible(timeout=60_000)
            wait_in(page, f"location.href.includes('project={name}')")
        assert page.evaluate("localStorage.getItem('noted')") is None
        page.close()
