"""Private parts of viser and websockets: which ones are used, and that nothing outside `transport/` uses any."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import carts_viewer
from carts_core.resources import static_dir

PACKAGE = Path(carts_viewer.__file__).parent
TOOLS = PACKAGE.parent / "tools"
USED = {
    "transport/viser_private.py": {
        "viser._gui_api",
        "viser._gui_handles",
        "viser._icons",
        "viser._messages",
        "_impl",
        "_gui_input_handle_from_uuid",
        "_data",
        "_websock_connection",
        "viser.infra._infra",
        "viser.infra._async_message_buffer",
    },
}
"""Every private name of theirs, by the module that uses it. Look at each when viser is updated."""
REPLACED = {
    "transport/viser_private.py": {
        "_infra.AsyncMessageBuffer",
        "_gui_api.svg_from_icon",
        "_gui_handles.svg_from_icon",
    },
    "transport/guard.py": {"websockets.asyncio.server.serve"},
}
"""What is replaced in their modules while a server starts."""
SCRIPTS = ("page.js", "paint.js", "marks.js", "loupe.js", "drag.js", "timeline.js", "shell.js", "document.js")
IN_THE_PAGE = {name: {"__viserMutable"} for name in SCRIPTS}
"""What our scripts use of viser's page that it does not document."""


def private_names(module: ast.Module) -> Iterator[str]:
    """Private modules that are imported, and private attributes of anything but the own object."""
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if "._" in alias.name)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (node.module or "" if "._" in (node.module or "") else name for name in names if "._" in name)
        elif isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                yield node.attr


def replaced_names(module: ast.Module) -> Iterator[str]:
    """Attributes of imported modules that are assigned to, by their full names."""
    modules = {
        (alias.asname or alias.name).split(".")[0]
        for node in ast.walk(module)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    for node in ast.walk(module):
        for target in node.targets if isinstance(node, ast.Assign) else ():
            name = ast.unparse(target)
            if isinstance(target, ast.Attribute) and name.split(".")[0] in modules:
                yield name


def _found(search, folder: Path) -> dict[str, set[str]]:
    texts = {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in folder.rglob("*.py")}
    found = {name: set(search(ast.parse(text))) for name, text in texts.items()}
    assert found
    return {name: names for name, names in found.items() if names}


def test_every_private_name_of_viser_that_is_used_is_in_the_list() -> None:
    assert _found(private_names, PACKAGE) == USED


def test_everything_that_is_replaced_in_other_packages_is_in_the_list() -> None:
    assert _found(replaced_names, PACKAGE) == REPLACED


def test_the_measuring_tools_use_nothing_private() -> None:
    assert _found(private_names, TOOLS) == {}


def test_what_our_scripts_use_of_the_page_of_viser_is_in_the_list() -> None:
    texts = {path.name: path.read_text(encoding="utf-8") for path in static_dir().glob("*.js")}
    found = {name: set(re.findall(r"__viser\w*", text)) for name, text in texts.items()}
    assert {name: names for name, names in found.items() if names} == IN_THE_PAGE
