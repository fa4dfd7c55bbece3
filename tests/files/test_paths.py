"""Names that may be part of a path, and those that may not."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carts_core.errors import OutputError
from carts_core.files import check_name, name_fault, output_path, unique_file_names


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
    with pytest.raises(
        OutputError, match=rf"(?s)the name of a camera is .*{why}.*1 to 200 bytes, without /.*Rename it"
    ):
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
