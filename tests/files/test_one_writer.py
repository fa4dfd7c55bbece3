"""Nothing but `carts_core.files` writes to disk: the source of both packages is searched for calls that could."""

import ast
from collections.abc import Iterator
from pathlib import Path

import carts_core
import carts_viewer

PACKAGES = [Path(package.__file__ or "").parent for package in (carts_core, carts_viewer)]
WRITERS = {
    *("write_text", "write_bytes", "touch", "mkdir", "makedirs", "rename", "renames", "unlink", "rmdir", "removedirs"),
    *("rmtree", "copyfile", "copy2", "copytree", "symlink", "symlink_to", "hardlink_to", "link", "mkfifo", "mknod"),
    *("truncate", "ftruncate", "chmod", "chown", "utime", "extractall", "extract", "tofile", "savetxt", "to_csv"),
    *("imwrite", "imwritemulti", "savefig", "save", "savez", "savez_compressed", "save_file", "export"),
    *("mkstemp", "mkdtemp", "NamedTemporaryFile", "VideoWriter", "FileStorage", "flock", "lockf"),
}
"""Functions and methods that write when their first argument is a path."""
INTO_MEMORY = {"save", "savetxt", "savez", "savez_compressed", "savefig"}
"""Those of them that write to an open stream just as well; it is called `stream` or `file` here."""
OWN_METHODS = {
    "save": "Controller.save and Editor.save put an edit into the project",
    "export": "carts_core.export.export goes through `published`",
    "write_text": "carts_core.files.write_text, called by its name alone",
    "write_bytes": "carts_core.files.write_bytes, called by its name alone",
    "link": "Robot's links",
}
"""Names that functions of ours have, too: a plain call `write_text(...)`, or a method without arguments, is ours."""
ALLOWED = {
    "carts_core/project": "SQLite writes the project by itself; tests/project attacks its path, its lock and its log",
    "carts_viewer/serving.py": "chmod of a page in a temporary folder that this user alone may look into",
}


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            name = path.relative_to(package.parent).as_posix()
            if not name.startswith("carts_core/files/") and not any(name.startswith(allowed) for allowed in ALLOWED):
                yield name, ast.parse(path.read_text(encoding="utf-8"))


def writing_calls(module: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of every call that could write to a path."""
    streams = {"stream", "file", *_in_memory(module)}
    for node in ast.walk(module):
        if not isinstance(node, ast.Call):
            continue
        method = isinstance(node.func, ast.Attribute)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in ("open", "fdopen") and _opens_for_writing(node, streams):
            yield node.lineno, name
        elif name == "replace" and _of(node) in ("os", "path", "part", "partial"):
            yield node.lineno, name
        elif (_of(node), name) in (("os", "remove"), ("sqlite3", "connect")):
            yield node.lineno, name
        elif name in WRITERS and not _is_harmless(node, name, method, streams):
            yield node.lineno, name


def _in_memory(module: ast.Module) -> Iterator[str]:
    """Names of variables that are made as a file in memory."""
    for node in ast.walk(module):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            made = node.value.func.attr if isinstance(node.value.func, ast.Attribute) else _name(node.value.func)
            if made in ("BytesIO", "StringIO"):
                yield from (_name(target) for target in node.targets)


def _of(call: ast.Call) -> str:
    """What a method is called on, if it has a plain name."""
    value = call.func.value if isinstance(call.func, ast.Attribute) else None
    return value.id if isinstance(value, ast.Name) else ""


def _opens_for_writing(call: ast.Call, streams: set[str]) -> bool:
    if _of(call) in ("os", "webbrowser"):
        return _of(call) == "os" and ast.unparse(call.args[0]) != "os.devnull"
    given = [*call.args, *(keyword.value for keyword in call.keywords)]
    modes = [value.value for value in given if isinstance(value, ast.Constant) and isinstance(value.value, str)]
    into_stream = bool(call.args) and _name(call.args[0]) in streams
    return any(set(mode) <= set("rwaxbt+") and set(mode) & set("wax+") for mode in modes) and not into_stream


def _is_harmless(call: ast.Call, name: str, method: bool, streams: set[str]) -> bool:
    if name in INTO_MEMORY and call.args and _name(call.args[0]) in streams:
        return True
    if name == "export" and any(_name(argument) in streams for argument in call.args):
        return True  # torch.onnx.export
    if name not in OWN_METHODS:
        return False
    if name == "save" and method:
        return not call.args or _name(call.args[0]) == "figures"
    return not method


def _name(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else ""


def test_no_other_module_writes_to_a_path() -> None:
    found = [f"{name}:{line}: {call}" for name, module in _modules() for line, call in writing_calls(module)]
    assert not found, "write through carts_core.files instead:\n" + "\n".join(found)


WRITING = """
open(path, 'w'); open(path, mode='ab'); path.open('x'); path.write_text('a'); (folder / name).write_bytes(content)
os.open(path, os.O_WRONLY | os.O_CREAT); os.replace(part, path); part.replace(path); os.remove(path)
path.unlink(missing_ok=True); shutil.rmtree(folder); folder.mkdir(parents=True); os.makedirs(folder)
cv2.imwrite(name, image); image.save(path); figure.savefig(path, dpi=110); np.savez(path, a=a); save_file(tensors, path)
mesh.export(path); av.open(str(path), 'w'); json.dump(content, open(path, 'w')); sqlite3.connect(path)
tempfile.NamedTemporaryFile(dir=folder); ZipFile(path).extractall(folder)
"""
HARMLESS = """
open(path); path.open('rb'); path.open(newline='', encoding='utf-8'); text.replace('a', 'b'); names.remove(name)
dataclasses.replace(config, noise=0); write_text(path, text); figure.savefig(stream, format='png')
content = io.BytesIO(); np.savez(content, a=a); av.open(file, 'w', format='mp4'); Sequence.open(path)
os.open(os.devnull, os.O_WRONLY); export(dataset, 'coco', path); self.save(); self.server.connect()
"""


def test_the_search_finds_every_way_to_write_and_leaves_reading_and_streams_alone() -> None:
    for code in WRITING.strip().replace("\n", "; ").split("; "):
        assert list(writing_calls(ast.parse(code))), code
    assert not list(writing_calls(ast.parse(HARMLESS)))
