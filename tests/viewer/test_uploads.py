"""Uploads: names, limits, nothing replaced, nothing half-written, and a folder chosen in a browser."""

import json
import os
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, FloatRect, Page, expect
from viewer_tab import box_of, new_context
from waiting import eventually
from websockets.exceptions import ConnectionClosedOK, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from carts_core.errors import CartsError, SettingsError
from carts_viewer.start import uploads
from carts_viewer.start.site import Site
from carts_viewer.start.uploads import receive, sanitized


def uploaded(root: Path, files: dict[str, bytes], size: Callable[[bytes], int] = len) -> Path:
    writer = receive(root, [(path, size(content)) for path, content in files.items()])
    try:
        next(writer)
        for content in filter(None, files.values()):
            writer.send(content)
    except StopIteration as end:
        return end.value
    finally:
        writer.close()
    raise AssertionError("the upload did not end")


def content_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_a_folder_keeps_its_name_and_nothing_is_replaced(tmp_path: Path) -> None:
    files = {"day 3/left/001.png": b"a", "day 3/log.csv": b"b", "day 3/empty.txt": b""}
    assert uploaded(tmp_path, files) == tmp_path / "day 3"
    assert content_of(tmp_path / "day 3") == {"left/001.png": b"a", "log.csv": b"b", "empty.txt": b""}
    assert uploaded(tmp_path, {"day 3/log.csv": b"c"}) == tmp_path / "day 3_2"
    assert (tmp_path / "day 3" / "log.csv").read_bytes() == b"b"
    assert uploaded(tmp_path, {"a.mp4": b"1", "b.csv": b"2"}) == tmp_path / "upload"


@pytest.mark.parametrize("path", ["../../x", "/etc/x", "a/../x", "..", "a\\b", "\x00x", ".ssh/x", "x\n", "é" * 300, ""])
def test_no_name_leaves_the_folder(tmp_path: Path, path: str) -> None:
    root = tmp_path / "root"
    root.mkdir()
    folder = uploaded(root, {path: b"x", "other/y": b"y"})
    assert folder.parent == root and {entry.name for entry in tmp_path.iterdir()} == {"root"}
    assert not any(part.startswith(".") or "/" in part or "\x00" in part for part in sanitized(path))


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([], "has 0 files"),
        ([("a/B", 1), ("a/b", 1)], "two files are named"),
        ([("a", uploads.MAX_BYTES), ("b", uploads.MAX_BYTES)], "GB are allowed"),
        ([("/".join("abcdefghi"), 1)], "levels deep"),
    ],
)
def test_uploads_beyond_the_limits_are_refused(tmp_path: Path, files: list[tuple[str, int]], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        next(receive(tmp_path, files))
    assert not list(tmp_path.iterdir())


def test_an_interrupted_upload_leaves_nothing(tmp_path: Path) -> None:
    writer = receive(tmp_path, [("a/1", 4), ("a/2", 4)])
    next(writer)
    writer.send(b"1234")
    writer.close()
    assert not list(tmp_path.iterdir())
    with pytest.raises(CartsError, match="changed during the upload"):
        uploaded(tmp_path, {"a/1": b"12345"}, size=lambda _: 4)
    assert not list(tmp_path.iterdir())


def test_only_the_start_page_accepts_uploads_of_its_own_origin(tmp_path: Path) -> None:
    root = tmp_path / "labs"
    root.mkdir()

    def offered(url: str, *messages: str | bytes, origin: Origin | None = None) -> list[dict[str, str]]:
        with connect(f"{url.replace('http', 'ws')}/upload", origin=origin, compression=None) as connection:
            answers = []
            for message in messages:
                connection.send(message)
                answers.append(json.loads(connection.recv(30)))
            return answers

    with Site([root], port=0) as site:
        site.wait()
        with pytest.raises(InvalidStatus):
            offered(site.url, origin=Origin("http://evil.example"))
        listing = json.dumps({"files": [["a/x.bin", 3]]})
        assert offered(site.url, listing, b"123") == [{"received": 0}, {"folder": str(root / "a")}]
        assert "error" in offered(site.url, "{}")[0]
        assert "error" in offered(site.url, listing, "text")[1]
        # A lost connection leaves nothing.
        offered(site.url, listing)
        eventually(lambda: [entry.name for entry in root.iterdir()] == ["a"])
        # Another page ends the upload.
        with connect(f"{site.url.replace('http', 'ws')}/upload", compression=None) as connection:
            connection.send(listing)
            assert json.loads(connection.recv(30)) == {"received": 0}
            site.post(site.show_recording)
            site.wait()
            with pytest.raises(ConnectionClosedOK):
                connection.send(b"12")
                connection.recv(5)
        eventually(lambda: [entry.name for entry in root.iterdir()] == ["a"])
        with pytest.raises(ConnectionClosedOK):
            offered(site.url, listing)


def drop(page: Page, path: Path, box: FloatRect) -> None:
    """Drag a file or folder from outside of the browser, and drop it in the middle of a box of the window."""
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    dragged = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    session = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, **at, "data": dragged})


@pytest.mark.browser
@pytest.mark.parametrize("dropped", [False, True])
def test_a_chosen_or_dropped_folder_becomes_a_new_recording(tmp_path: Path, browser: Browser, dropped: bool) -> None:
    root, source = tmp_path / "labs", tmp_path / "day 3"
    root.mkdir()
    (source / "left").mkdir(parents=True)
    (source / "left" / "001.png").write_bytes(os.urandom(2_000_000))
    (source / ".hidden").write_text("not uploaded")
    with Site([root], port=0) as site, closing(new_context(browser)) as context:
        page = context.new_page()
        page.goto(site.url)
        button = page.get_by_role("button", name="Choose a folder")
        if dropped:
            drop(page, source, box_of(button))
        else:
            with page.expect_file_chooser() as chooser:
                button.click(timeout=60_000)
            chooser.value.set_files(source)
        expect(page.get_by_role("heading", name="day 3")).to_be_visible(timeout=60_000)
        assert content_of(root) == {"day 3/left/001.png": (source / "left" / "001.png").read_bytes()}


@pytest.mark.browser
def test_an_upload_is_cancelled_and_another_can_follow(
    tmp_path: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, source, goes_on = tmp_path / "labs", tmp_path / "day 3", threading.Event()
    root.mkdir()
    source.mkdir()
    (source / "001.png").write_bytes(os.urandom(2_000_000))
    step = uploads._step
    monkeypatch.setattr(uploads, "_step", lambda *given: step(*given) if given[1] is None or goes_on.wait(30) else None)
    with Site([root], port=0) as site, closing(new_context(browser)) as context:
        page = context.new_page()
        page.goto(site.url)
        box = box_of(page.get_by_role("button", name="Choose a folder"))
        drop(page, source, box)
        cancel = page.get_by_role("button", name="Cancel")
        expect(cancel).to_be_visible(timeout=60_000)
        drop(page, source, box)
        expect(page.locator(".target output")).to_contain_text("An upload is running")
        cancel.click()
        expect(page.locator(".target output")).to_contain_text("Upload cancelled")
        expect(cancel).to_be_hidden()
        goes_on.set()
        eventually(lambda: list(root.iterdir()) == [])
        drop(page, source, box)
        expect(page.get_by_role("heading", name="day 3")).to_be_visible(timeout=60_000)


@pytest.mark.browser
def test_a_path_is_opened_or_the_reason_and_the_remedy_are_shown(tmp_path: Path, browser: Browser) -> None:
    root = tmp_path / "labs"
    (root / "day 3").mkdir(parents=True)
    with Site([root], port=0) as site, closing(new_context(browser)) as context:
        page = context.new_page()
        page.goto(site.url)
        field = page.get_by_label("Path on the computer of the viewer")
        field.fill("/etc/passwd", timeout=60_000)
        field.press("Enter")
        expect(page.get_by_role("alert")).to_contain_text("Restart carts view with --root FOLDER")
        expect(field).to_have_value("/etc/passwd")
        field.fill("/etc/hosts")
        page.get_by_role("button", name="Open path").click()
        expect(page.get_by_role("alert")).to_contain_text("/etc/hosts")
        expect(field).to_have_value("/etc/hosts")
        field.fill(str(root / "day 3"))
        page.get_by_role("button", name="Open path").click()
        expect(page.get_by_role("heading", name="day 3")).to_be_visible(timeout=60_000)
