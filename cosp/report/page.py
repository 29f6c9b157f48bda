"""The quality page of a site: one HTML file that holds its figures and tables."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { margin-bottom: 0.2rem; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.3rem; }
th, td { padding: 0.15rem 0.7rem; border-bottom: 1px solid #e4e4e4; text-align: left; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
figure { margin: 1rem 0; } figure img { max-width: 100%; } figcaption { color: #555; font-size: 13px; }
td, th { overflow-wrap: anywhere; } details { margin: 0.6rem 0; } summary { cursor: pointer; color: #245; }
details caption { display: none; } .scroll { overflow-x: auto; }
nav a { margin-right: 1rem; display: inline-block; } .key { font-size: 1.1rem; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure as the bytes of a PNG, and the sentence below it."""

    png: bytes
    caption: str


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers under a heading; numbers are set in a readable length."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Section:
    """A heading of the page with what stands below it; `details` are tables that stay folded until asked for."""

    heading: str
    text: str = ""
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    details: tuple[Table, ...] = ()


def picture(figure: Figure, caption: str, *, dpi: int = 110) -> Picture:
    """A drawn figure as a picture of the page; the same figure always gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return Picture(buffer.getvalue(), caption)


def build_page(title: str, summary: str, sections: Sequence[Section]) -> str:
    """The page as HTML with everything inside it, pictures too.

    title, summary and all texts are plain text.
    """
    links = " ".join(
        f'<a href="#section-{number}">{html.escape(section.heading)}</a>' for number, section in enumerate(sections)
    )
    body = "\n".join(_section(number, section) for number, section in enumerate(sections))
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{html.escape(title)}</h1>\n"
        f'<p class="key">{html.escape(summary)}</p>\n<nav>{links}</nav>\n{body}\n</body>\n</html>\n'
    )


def flat(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Single values of a nested record under dotted names; short lists count as single, long ones are left out."""
    for key, value in record.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flat(value, f"{name}.")
        elif isinstance(value, (list, tuple)):
            if len(value) <= 4 and not any(isinstance(item, (Mapping, list, tuple)) for item in value):
                yield name, ", ".join(readable(item) for item in value)
        else:
            yield name, value


def comparison(caption: str, records: Mapping[str, Mapping[str, Any]]) -> Table:
    """Records of one kind side by side: a row per value, a column per record."""
    values = {name: dict(flat(record)) for name, record in records.items()}
    keys = list(dict.fromkeys(key for record in values.values() for key in record if key not in ("kind", "version")))
    rows = tuple((key, *(record.get(key) for record in values.values())) for key in keys)
    return Table(caption, ("", *records), rows)


def readable(value: Any) -> str:
    """A value as text: numbers to four digits, nothing as a dash."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return str(value)


def _section(number: int, section: Section) -> str:
    parts = [f'<h2 id="section-{number}">{html.escape(section.heading)}</h2>']
    if section.text:
        parts.append(f"<p>{html.escape(section.text)}</p>")
    parts += [_picture(each) for each in section.pictures]
    parts += [_table(each) for each in section.tables]
    for each in section.details:
        parts.append(f"<details><summary>{html.escape(each.caption)}</summary>{_table(each)}</details>")
    return "\n".join(parts)


def _picture(each: Picture) -> str:
    source = base64.b64encode(each.png).decode()
    caption = html.escape(each.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{source}"><figcaption>{caption}</figcaption></figure>'
    )


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    rows = "\n".join("<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in table.rows)
    caption = html.escape(table.caption)
    return f'<div class="scroll"><table><caption>{caption}</caption>\n<tr>{head}</tr>\n{rows}\n</table></div>'


def _cell(value: Any) -> str:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    kind = ' class="number"' if number else ""
    return f"<td{kind}>{html.escape(readable(value))}</td>"
