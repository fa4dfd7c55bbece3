"""Reports from the Jinja2 templates in `carts_core/templates`. In HTML, all text is escaped."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from itertools import starmap
from typing import TYPE_CHECKING, NamedTuple

from .console import in_markdown

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


class Cell(NamedTuple):
    """Cell of a table."""

    text: str
    note: str = ""
    """Small text below the content."""


@dataclass(frozen=True)
class Table:
    """Table of a report."""

    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @property
    def body(self) -> "Markup":
        """Rows as escaped HTML; a template takes several times as long, which matters for 10,000 rows."""
        from markupsafe import Markup  # noqa: PLC0415

        def cell(text: str, note: str) -> str:
            return f"<td>{escape(text)}<small>{escape(note)}</small></td>" if note else f"<td>{escape(text)}</td>"

        return Markup("\n".join([f"<tr>{''.join(starmap(cell, row))}</tr>" for row in self.rows]))

    @staticmethod
    def of(title: str, caption: str, rows: Sequence[Mapping[str, str | Cell]]) -> "Table | None":
        """Table whose headings are the keys of its rows; None without rows."""
        if not rows:
            return None
        cells = [tuple([cell if isinstance(cell, Cell) else Cell(cell) for cell in row.values()]) for row in rows]
        return Table(title, caption, tuple(rows[0]), tuple(cells))


def render_page(template: str, **values: object) -> str:
    """Render a page from a template, given by its file name."""
    return _templates().get_template(template).render(values)


@cache
def _templates() -> "Environment":
    # Imported here, because `carts view` does not need reports.
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape  # noqa: PLC0415

    templates = Environment(
        loader=PackageLoader("carts_core"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= {"md": in_markdown, "json": json.dumps}
    return templates
