"""Components of HTML reports: tables, sections, figures and their style. All text is escaped."""

from dataclasses import dataclass
from html import escape
from pathlib import PurePath

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1f23; max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .3rem; }
h2 { margin-top: 2.6rem; border-bottom: 1px solid #d8dce0; padding-bottom: .2rem; }
h3 { margin: 1.6rem 0 .2rem; }
p { max-width: 62rem; margin: .3rem 0 .7rem; color: #4a5058; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .6rem; border-bottom: 1px solid #e4e7ea; text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid #aab2ba; font-weight: 600; }
td { white-space: nowrap; }
.targets td, .facts td { white-space: normal; }
.targets td:nth-child(n+2):nth-child(-n+4) { white-space: nowrap; }
.targets td:nth-child(5) { max-width: 15rem; }
small { display: block; color: #737b84; font-size: .8em; }
.met { color: #17713a; font-weight: 600; }
.missed { color: #b02a1c; font-weight: 600; }
.open { color: #737b84; }
.warning { border-left: 4px solid #d9a300; background: #fff8e0; padding: .4rem .8rem; color: #5a4500; }
nav a { margin-right: .8rem; }
figure { margin: 1.4rem 0 2rem; }
figure img { max-width: 100%; }
figcaption { color: #4a5058; max-width: 62rem; }
"""


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    note: str = ""
    """Small text below the content."""


@dataclass(frozen=True)
class Table:
    """A table of a report."""

    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def anchor(title: str) -> str:
    """Anchor of the section for links."""
    return title.lower().replace(" ", "-")


def section_html(title: str, body: str) -> str:
    """A section with a heading; `body` is HTML."""
    return f'<section id="{anchor(title)}"><h2>{escape(title)}</h2>{body}</section>'


def table_html(table: Table) -> str:
    """A table with its title and caption."""
    header = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    rows = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
    return (
        f"<h3>{escape(table.title)}</h3><p>{escape(table.caption)}</p>"
        f'<div class="wide"><table><thead><tr>{header}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def figure_html(caption: str, path: PurePath) -> str:
    """A picture with a caption."""
    return (
        f'<figure><img src="{escape(path.as_posix())}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _cell(cell: Cell) -> str:
    note = f"<small>{escape(cell.note)}</small>" if cell.note else ""
    return f"<td>{escape(cell.text)}{note}</td>"
