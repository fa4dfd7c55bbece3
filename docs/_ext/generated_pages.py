"""Pages that are written from the code at build time: commands, settings, the Python API and the examples.

They go to folders called `_generated`, which git ignores, and are rewritten only where they change.
"""

from pathlib import Path

from api_pages import api_pages
from command_pages import command_pages
from example_pages import example_pages
from settings_page import settings_page
from sphinx.application import Sphinx

FOLDER = "_generated"


def write_pages(app: Sphinx) -> None:
    """Update every generated page, and remove obsolete ones."""
    source = Path(app.srcdir)
    pages = {
        source / "reference" / FOLDER / name: text
        for name, text in {**command_pages(), "settings.md": settings_page(), **api_pages()}.items()
    }
    pages |= {source / "examples" / FOLDER / name: text for name, text in example_pages().items()}
    for path, text in pages.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for folder in {path.parent for path in pages}:
        for left_over in set(folder.glob("*.md")) - set(pages):
            left_over.unlink()


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
