"""Writing of files, lines, locks and table cells, and names in paths."""

import os
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted import PLANTED, PRECIOUS, contents, die, killed, plant, treasure

from carts_core.errors import OutputError
from carts_core.files import (
    BusyError,
    append_line,
    check_name,
    csv_cell,
    holds_file,
    locked_folder,
    name_fault,
    output_path,
    output_stream,
    published,
    remove_file,
    text_of_cell,
    unique_file_names,
    write_bytes,
    write_text,
)


def test_a_file_is_written_with_the_folders_on_the_way(tmp_path: Path) -> None:
    path = output_path(tmp_path, "masks", "left", "001.png")
    write_bytes(path, b"one")
    write_bytes(path, b"two")
    assert path.path.read_bytes() == b"two" and holds_file(path)
    assert contents(tmp_path).keys() == {"masks", "masks/left", "masks/left/001.png"}
    allowed = 0o666 & ~_umask()
    assert stat.S_IMODE(path.path.stat().st_mode) == allowed


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("nameless", [True, False])
def test_a_failed_write_keeps_the_old_file(tmp_path: Path, nameless: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not nameless:
        monkeypatch.setattr("carts_core.files.writing._NAMELESS", 0)
    write_text(tmp_path / "a", "old")
    with pytest.raises(KeyboardInterrupt), output_stream(tmp_path / "a") as stream:
        stream.write(b"half")
        raise KeyboardInterrupt
    assert (tmp_path / "a").read_text() == "old" and os.listdir(tmp_path) == ["a"]
    write_text(tmp_path / "a", "new")
    assert (tmp_path / "a").read_text() == "new" and os.listdir(tmp_path) == ["a"]


def test_a_kill_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "old")

    def write_half() -> None:
        with output_stream(tmp_path / "a") as stream:
            stream.write(b"half" * 100_000)
            stream.flush()
            die()

    assert killed(write_half)
    assert (tmp_path / "a").read_text() == "old" and os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("kind", PLANTED)
@pytest.mark.parametrize("depth", [1, 2, 3])
def test_what_is_planted_below_an_output_folder_is_not_followed(tmp_path: Path, kind: str, depth: int) -> None:
    home = treasure(tmp_path / "home")
    before = contents(home)
    path = output_path(tmp_path / "out", "masks", "left", "001.png")
    plant(kind, output_path(tmp_path / "out", *path.names[:depth]).path, home)
    for write in (
        lambda: write_bytes(path, b"new"),
        lambda: append_line(path, b"new"),
        lambda: remove_file(path),
        lambda: locked_folder(path.parent).__enter__(),
        lambda: published(path, overwrite=True).__enter__(),
    ):
        try:
            write()
        except OutputError as error:
            assert "Remove it" in str(error) or "Choose a" in str(error), error
        except FileNotFoundError:
            pass
        assert contents(home) == before
    if kind == "folder":
        assert (tmp_path / "out" / Path(*path.names[:depth]) / "own.txt").read_text() == PRECIOUS


def test_the_folder_that_a_person_names_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "large disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "large disk")
    write_text(output_path(tmp_path / "out", "a"), "new")
    assert (tmp_path / "large disk" / "a").read_text() == "new"


def test_a_link_under_the_name_of_a_file_is_replaced_and_not_followed(tmp_path: Path) -> None:
    home = treasure(tmp_path / "home")
    (tmp_path / "a").symlink_to(home / "bashrc")
    assert not holds_file(tmp_path / "a")
    write_text(tmp_path / "a", "new")
    assert (home / "bashrc").read_text() == PRECIOUS and (tmp_path / "a").read_text() == "new"
    assert holds_file(tmp_path / "a")


def test_lines_are_added_and_a_torn_one_is_ended(tmp_path: Path) -> None:
    append_line(tmp_path / "results" / "a.jsonl", b"1")
    with (tmp_path / "results" / "a.jsonl").open("ab") as stream:
        stream.write(b"to")
    append_line(tmp_path / "results" / "a.jsonl", b"2")
    assert (tmp_path / "results" / "a.jsonl").read_bytes() == b"1\nto\n2\n"


def test_a_folder_is_locked_for_others_until_the_block_ends(tmp_path: Path) -> None:
    with locked_folder(tmp_path / "out"):
        with pytest.raises(BusyError, match=r"another process is writing to .*out"), locked_folder(tmp_path / "out"):
            pass
    with locked_folder(tmp_path / "out"):
        assert os.listdir(tmp_path / "out") == []


def test_a_disk_that_refuses_is_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot be written \(Not a directory\).*choose a writable folder"):
        write_text(tmp_path / "file" / "out", "new")


@pytest.mark.parametrize("text", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\tx", "\rx", "-", "'quoted"])
def test_a_cell_is_no_formula(text: str) -> None:
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["001", "-0.5", "+3", "1e-9", "PSM1.yaw", "ü", ""])
def test_numbers_and_plain_texts_stay_as_they_are(text: str) -> None:
    assert csv_cell(text) == text


@given(st.text())
def test_a_cell_gives_its_text_back(text: str) -> None:
    assert text_of_cell(csv_cell(text)) == text
    assert not csv_cell(text).startswith(("=", "@", "\t", "\r"))


@pytest.mark.parametrize("name", ["001", "linke Kamera (ü)", "手術", "a..b", "a.", " ", "PSM 1 & <b>", "x" * 200, "~"])
def test_names_of_any_script_are_allowed(name: str) -> None:
    assert check_name(name, "a camera") == name


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("", "empty"),
        (".", "starts with a dot"),
        ("..", "starts with a dot"),
        (".ssh", "starts with a dot"),
        ("/tmp/x", "contains the path separator '/'"),
        ("../../x", "starts with a dot"),
        ("a/../../x", "contains the path separator '/'"),
        ("a\\b", r"contains the path separator '\\\\'"),
        ("a\0b", "control character"),
        ("a\x1b[31mb", "control character"),
        ("a\nb", "control character"),
        ("a\ud800b", "control character"),
        ("ü" * 101, "202 bytes long"),
    ],
)
def test_other_names_are_refused_with_what_is_allowed(name: str, why: str) -> None:
    with pytest.raises(OutputError, match=rf"(?s)the name of a camera is .*{why}.*1 to 200 bytes, and no /.*Rename it"):
        check_name(name, "a camera")


def test_a_path_is_made_of_single_components(tmp_path: Path) -> None:
    path = output_path(tmp_path, "regular", "left") / "001.png"
    assert path.path == tmp_path / "regular" / "left" / "001.png" and os.fspath(path) == str(path.path)
    assert path.parent == output_path(tmp_path, "regular", "left") and path.name == "001.png"
    with pytest.raises(OutputError, match="256 bytes long"):
        _ = path / ("x" * 252 + ".png")


@given(st.lists(st.text() | st.sampled_from(["..", ".", "/", "/tmp/x", "../x", "a/../..", "\0", "~"]), min_size=1))
def test_no_name_leads_out_of_the_folder(names: list[str]) -> None:
    folder = Path("/home/somebody/out")
    try:
        path = output_path(folder, *names).path
    except OutputError:
        assert any(name_fault(name, 255) for name in names)
        return
    assert Path(os.path.normpath(path)) == path
    assert path.parts[: len(folder.parts)] == folder.parts and len(path.parts) == len(folder.parts) + len(names)


@given(st.lists(st.text(), max_size=20))
def test_any_text_becomes_a_name_of_its_own(texts: list[str]) -> None:
    names = unique_file_names(texts)
    assert len({name.casefold() for name in names}) == len(texts)
    assert all(name_fault(name, 255 - len(".png")) is None for name in names)
