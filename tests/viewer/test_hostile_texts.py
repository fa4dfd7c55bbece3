"""Texts of a recording, a project, a batch and an import that are HTML, SVG or links: they stay texts everywhere.

The page's policy is switched off here, so that a text that became HTML would run.
"""

import csv
import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from itertools import count
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from playwright.sync_api import Browser
from playwright.sync_api import Page as Tab
from viewer_tab import READY, dismiss_warning, new_context
from waiting import wait_in

from carts_core.batch.folder import Findings, FrameFinding, write_jobs, write_state
from carts_core.batch.folder import JobState as BatchJobState
from carts_core.batch.manifest import Job as BatchJob
from carts_core.batch.report import write_batch_report
from carts_core.files import output_path
from carts_core.project import FitVerdict, JointCorrection, Key, Project, Provenance, Review, ReviewState, Source
from carts_core.recording import Sequence
from carts_core.resources import shipped_robot
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.job_list import AdaptOptions, CalibrateOptions, Job, JobState, SolveOptions
from carts_viewer.start.site import Site

pytestmark = pytest.mark.browser
WINDOWS = [(1000, 640), (390, 700)]
LEAKS = """() => [...window.ran, ...[...document.querySelectorAll("[onerror], [onload], [onfocus], [href^=javascript]")]
  .map((one) => one.outerHTML)]"""
"""Markers of scripts that have run, and elements that a text has become."""


SHOWN = "((document.title + document.body.innerHTML).match(/ran\\.push\\(\\d+\\)/g) ?? []).join()"


class Texts:
    """Hostile texts, each with a number that identifies the origin of an executed script."""

    def __init__(self) -> None:
        self._numbers, self.places = count(1), dict[int, str]()
        self.reached: set[str] = set()
        """Places whose texts have been in the page."""

    def __call__(self, place: str) -> str:
        number = next(self._numbers)
        self.places[number] = place
        run = f"ran.push({number})"
        # No slash, so that it can be a name of a file; out of quotes, an element, an SVG, and Markdown.
        return f"{number}\"'><img src=x onerror={run}><svg onload={run}>[a](javascript:{run})"


@pytest.fixture
def texts() -> Texts:
    return Texts()


def write_robot(folder: Path, texts: Texts) -> dict[str, str]:
    """The shipped robot with hostile names of links and joints as `robot.urdf`; gives joints by their old name."""
    shutil.copytree(shipped_robot().parent, folder, dirs_exist_ok=True)
    urdf, joints = shipped_robot().read_text(), {}
    for kind in ("link", "joint"):
        for name in dict.fromkeys(re.findall(rf'<{kind} name="([^"]+)"', urdf)):
            new = texts(f"{kind} {name}")
            joints |= {name: new} if kind == "joint" else {}
            quoted = new.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
            urdf = re.sub(rf'(name|link|joint)="{re.escape(name)}"', lambda match, q=quoted: f'{match[1]}="{q}"', urdf)
    (folder / "robot.urdf").write_text(urdf)
    return joints


def write_recording(tiny_sequence: Callable[..., Path], texts: Texts) -> Path:
    """A recording whose every name is hostile: sequence, domain, camera, arm, joints, links, frames, columns, files."""
    made = tiny_sequence(frames=2, cameras=("left", "right"), masks=False, truth=False).parent
    folder = made / texts("folder")
    joints = write_robot(folder, texts)
    with (made / "kinematics.csv").open() as stream, (folder / "kinematics.csv").open("w", newline="") as new:
        header, *rows = csv.reader(stream)
        columns = {name: texts("column") for name in header[2:]}
        csv.writer(new).writerows([["frame", "time", *columns.values()], *([texts("frame"), *row[1:]] for row in rows)])
    shutil.copytree(made / "regular", folder / "images")
    quoted = {
        name: json.dumps(texts(place))
        for place, names in (("sequence", ["tiny"]), ("camera", ["left", "right"]), ("arm", ["PSM1"]))
        for name in names
    }
    toml = (made / "sequence.toml").read_text().replace('frame_id = "{frame:03d}"\n', "")
    toml = toml.replace("['regular']", f"[{json.dumps(texts('domain'))}]").replace("builtin:psm_lnd", "robot.urdf")
    for camera in ("left", "right"):
        toml = toml.replace('images = "{domain}/{camera}/{frame}.png"', f'images = "images/{camera}/*.png"', 1)
    toml = re.sub(r'(?m)^name = "(\w+)"', lambda match: f"name = {quoted[match[1]]}", toml)
    for name, column in columns.items():
        toml = toml.replace(f'\n{name} = "{name}"', f"\n{json.dumps(joints[name])} = {json.dumps(column)}")
    file = folder / f"{texts('file')}.toml"
    file.write_text(toml)
    return file


def write_companions(file: Path, texts: Texts) -> list[str]:
    """What lies beside a recording: its project, jobs, choice of network, files to import, by name."""
    sequence = Sequence.open(file)
    arm, camera = sequence.scene.arms[0], sequence.scene.cameras[0].name
    with Project.open(sequence) as project:
        joints = JointCorrection((0.01,) * len(arm.robot.joint_names), Provenance(Source.HAND))
        project.apply(texts("step"), {Key.joints(0, arm.name): joints})
        project.apply("Note", {Key.review(0): Review(ReviewState.NEEDS_WORK, texts("note"))})
        cameras = ((camera, 0.9), (texts("camera of a verdict"), 0.8))
        verdict = FitVerdict("failed", texts("reason"), texts("remedy"), 0.9, cameras)
        project.record_verdict(0, verdict)
        project.log_export(texts("format"), file.parent / texts("export"), 1, {})
    kinds = {"solve": SolveOptions(), "calibrate": CalibrateOptions(2), "adapt": AdaptOptions(1, 1)}
    states = (JobState.DONE, JobState.FAILED, JobState.CANCELLED)
    jobs = [
        asdict(Job(number, kind, texts("job"), options, state, text=texts("job's text"), log=(texts("job's log"),)))
        for number, ((kind, options), state) in enumerate(zip(kinds.items(), states, strict=True), 1)
    ]
    (file.parent / f"{file.stem}_jobs.json").write_text(json.dumps(jobs))
    (file.parent / f"{file.stem}_network.json").write_text(json.dumps({"network": texts("network")}))
    square = [[30, 20, 60, 20, 60, 50, 30, 50]]
    labels = {"id": 1, "name": texts("label"), "keypoints": [texts("keypoint")]}
    mark = {"id": 1, "image_id": 1, "category_id": 1, "segmentation": square, "keypoints": [40.0, 30.0, 2]}
    image = {"id": 1, "file_name": f"{sequence.frame_ids[0]}.png", "width": 96, "height": 72}
    content = {"images": [image], "annotations": [mark], "categories": [labels]}
    contents = {f"{texts('import')}.json": json.dumps(content), f"{texts('broken import')}.json": texts("words")}
    for name, text in contents.items():
        (file.parent / name).write_text(text)
    return list(contents)


def check(page: Tab, texts: Texts) -> None:
    """Nothing has run, and no text has become an element."""
    leaks = page.evaluate(LEAKS)
    assert not leaks, ({texts.places.get(number) for leak in leaks for number in _numbers(str(leak))}, leaks[:3])
    texts.reached |= {texts.places[number] for number in _numbers(page.evaluate(SHOWN)) if number in texts.places}


def _numbers(text: str) -> set[int]:
    return {int(number) for number in re.findall(r"ran\.push\((\d+)\)", text)}


def rest_on_everything(page: Tab) -> None:
    """Have the pointer over every control, and each field focused, so that what explains them is shown."""
    page.evaluate("""() => { for (const one of document.querySelectorAll("button, label, input, [title], canvas")) {
        one.dispatchEvent(new MouseEvent("mouseover", {bubbles: true}));
        one.dispatchEvent(new PointerEvent("pointerover", {bubbles: true}));
    } }""")


CHOOSE = """(number) => {
  const tab = document.querySelectorAll("[role=tab]")[number];
  for (const kind of ["pointerdown", "pointerup"]) {
    tab?.dispatchEvent(new PointerEvent(kind, {bubbles: true, button: 0}));
  }
  tab?.click();
}"""
"""Choose a tab of a panel."""
LISTS = "[...document.querySelectorAll('input[aria-haspopup=listbox]')].map((one) => one.id)"
UNFOLD = """() => { for (const label of document.querySelectorAll(".mantine-Paper-root > .mantine-Paper-root"))
    if (!label.nextElementSibling?.clientHeight) label.click(); }"""
"""Open every folder of the shown tabs that is closed."""


SETTLED = """() => new Promise((done) => {
  let frames = 0, all = 0;
  const observer = new MutationObserver(() => { frames = 0; });
  observer.observe(document.body, { subtree: true, childList: true });
  const look = () => {
    if (++frames > 3 || ++all > 40) { observer.disconnect(); done(); } else requestAnimationFrame(look);
  };
  look();
})"""
"""Resolves once nothing was added to the page, or removed, for three frames, or after forty."""


def check_settled(page: Tab, texts: Texts) -> None:
    """Check a page once all that was asked for is there."""
    page.evaluate(SETTLED)
    check(page, texts)


def walk(page: Tab, texts: Texts, *, lists: bool) -> None:
    """Open every tab, folder and sheet of the viewer, and every list where that is asked for."""
    page.bring_to_front()  # Chromium draws a page in the background once a second.
    seen: set[str] = set()
    for number in range(page.locator("[role=tab]").count()):
        page.evaluate(f"({CHOOSE})({number})")
        page.evaluate(UNFOLD)
        page.evaluate(SETTLED)
        for name in set(page.evaluate(LISTS)) - seen if lists else ():
            seen.add(name)
            page.evaluate("(name) => document.getElementById(name)?.click()", name)
            check_settled(page, texts)
        rest_on_everything(page)
        check_settled(page, texts)
    for key in ("?", "Escape", "Control+k", "Escape", "n"):
        page.keyboard.press(key)
        check_settled(page, texts)


@pytest.fixture
def opened(browser: Browser) -> Iterator[Callable[..., Tab]]:
    """Opens tabs without the page's policy."""
    with closing(new_context(browser, bypass_csp=True)) as context:

        def make(address: str, window: tuple[int, int], name: str = "") -> Tab:
            page = context.new_page()
            page.set_viewport_size({"width": window[0], "height": window[1]})
            page.add_init_script(f"window.ran = []; localStorage.setItem('carts-name', {json.dumps(name)})")
            page.goto(address)
            return page

        yield make


@pytest.mark.timeout(900)
@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_texts_of_a_recording_and_its_project_stay_texts_in_the_viewer(
    tiny_sequence: Callable[..., Path],
    untrained_weights: Path,
    texts: Texts,
    opened: Callable[..., Tab],
    whole: bool,
) -> None:
    """The whole walk opens every list, and a phone's page, too."""
    file = write_recording(tiny_sequence, texts)
    imports = write_companions(file, texts)
    with ViewerApp.open(file, port=0, weights=(untrained_weights,), folders=(file.parent,)) as app:
        app.wait_until_shown()
        windows = WINDOWS if whole else WINDOWS[:1]
        pages = [opened(app.url, window, "<img src onerror=ran.push(0)>") for window in windows]
        for page in pages:
            wait_in(page, READY)
            dismiss_warning(page)
            check(page, texts)
        for step in (
            *(intents.ImportMasks(name, app.scene.cameras[0].name) for name in imports),
            intents.ImportMasks(texts("missing import")),
            intents.SetJoint(app.scene.arms[0].name, 0, 0.1),
            intents.Export("csv", "All"),
            intents.Assess(),
            intents.ShowDomain(texts("missing domain")),
            intents.UseNetwork(texts("missing network")),
            intents.StartLive(texts("missing source")),
            intents.Export(texts("missing format"), "All"),  # pyright: ignore
            intents.Step(),
        ):
            app.queue.put(step)
            app.wait_until_shown()
            said = [f"ran.push({number})" for number in _numbers(app.state.error or "")]
            wait_in(pages[0], f"{json.dumps(said)}.every(one => document.body.innerHTML.includes(one))")
            for page in pages:
                check(page, texts)
        walk(pages[0], texts, lists=whole)
        pages[0].close()
        if whole:
            pages[1].locator(".carts-review-bar").wait_for()
            pages[1].get_by_role("button", name="All controls").click()
            walk(pages[1], texts, lists=False)
        recording = ("sequence", "domain", "camera", "arm", "frame", "joint yaw", "file", "folder", "label", "import")
        project = ("step", "note", "reason", "remedy", "job's text", "job's log", "missing domain")
        # Some are seen in lists alone.
        assert texts.reached > ({*recording, *project} if whole else {"sequence"})


def test_names_of_files_columns_and_drafts_stay_texts_on_the_start_page_and_in_new_recording(
    tiny_sequence: Callable[..., Path], tmp_path: Path, texts: Texts, opened: Callable[..., Tab]
) -> None:
    made = tiny_sequence(frames=2).parent
    root = tmp_path / texts("root")
    folder = root / texts("folder")
    shutil.copytree(made / "regular" / "left", folder / texts("images"))
    names = [f"axis_{number}" for number in range(1, 7)]
    with (folder / f"{texts('table')}.csv").open("w", newline="") as stream:
        rows = [["picture", *names, texts("column"), texts("column")]]
        rows += [[f"{number:03d}", *(f"{0.01 * number:.3f}" for _ in range(8))] for number in (1, 2)]
        csv.writer(stream).writerows(rows)
    (root / f"{texts('broken')}.toml").write_text(f"format = {json.dumps(texts('format'))}")
    recording = write_recording(tiny_sequence, texts)
    with Site([root], port=0) as site:
        site.post(lambda: site.open_sequence(recording))
        site.post(site.show_start)
        site.wait()
        page = opened(site.url, WINDOWS[0])
        main = page.locator("main")
        main.get_by_role("heading", name="Correct a robot's kinematics from its image").wait_for()
        check(page, texts)
        main.get_by_role("button", name="Open a sequence file …").click()
        main.locator(".files button:enabled", has_text="toml").first.click()
        main.get_by_role("alert").wait_for()
        check(page, texts)
        main.get_by_role("button", name="New recording").click()
        main.locator(".files button").first.click()
        main.get_by_role("button", name="Choose this folder").click()
        main.get_by_role("heading", name="Arms and joints").wait_for()
        for details in main.locator("summary").all():
            details.click()
        rest_on_everything(page)
        check_settled(page, texts)
        main.get_by_role("button", name="All recordings").click()
        main.get_by_role("heading", name="Unfinished imports").wait_for()
        check(page, texts)
        assert texts.reached > {"root", "folder", "images", "table", "column", "broken", "format"}
        assert texts.reached > {"file", "sequence"}, "the recent recording"


def test_texts_of_a_batch_stay_texts_in_its_page_and_in_its_report(
    tiny_sequence: Callable[..., Path], tmp_path: Path, texts: Texts, opened: Callable[..., Tab]
) -> None:
    recording = tiny_sequence(frames=2)
    batch = tmp_path / texts("batch")
    jobs = [BatchJob(texts("job"), recording, texts("camera"), texts("domain"), ("optimize",), {}) for _ in range(2)]
    write_jobs(output_path(batch), jobs)
    for job in jobs:
        place = output_path(batch) / "jobs" / job.name
        write_state(place, BatchJobState("failed", error=texts("error"), worker=texts("worker")))
        cv2.imwrite(str(place.path / "worst.png"), np.zeros((8, 8, 3), np.uint8))
        frame = FrameFinding(texts("camera"), texts("frame"), texts("verdict"), texts("reason"), 0.9, "worst.png")
        base = {texts("base frame"): np.eye(4).tolist()}
        joint = {texts("arm") + "." + texts("joint"): [0.1, 0.2]}
        findings = Findings(texts("recording"), [frame], joint, joint, base)
        content = {"format": "carts-findings/1", **msgspec.to_builtins(findings)}
        (place.path / "findings.json").write_text(json.dumps(content))
    report = write_batch_report(output_path(batch), texts("title"), jobs)
    with Site([tmp_path], port=0, batch=batch) as site:
        page = opened(site.url, WINDOWS[1])
        page.locator("main .jobs tbody tr").nth(1).wait_for()
        rest_on_everything(page)
        check(page, texts)
        page.goto(report.as_uri())
        check_settled(page, texts)
        assert texts.reached > {"batch", "job", "error", "verdict", "reason", "frame", "camera", "title", "joint"}
