"""The parts of a page, and the function that writes the page. The template escapes all text from run folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar


@dataclass
class Table:
    """A table whose first column holds row headers. `text` aligns the other columns left instead of right."""

    kind: ClassVar[str] = "table"
    caption: str
    heading: Sequence[str]
    rows: Sequence[Sequence[Any]]
    text: bool = False


@dataclass
class Picture:
    """A picture as a data URI. Its caption is also its text alternative. A `wide` picture scrolls on small screens."""

    kind: ClassVar[str] = "picture"
    source: str
    caption: str
    wide: bool = False


@dataclass
class Strip:
    """Pictures with titles, side by side; on small screens, one below the other."""

    kind: ClassVar[str] = "strip"
    caption: str
    pictures: Sequence[tuple[str, str]]  # (data URI, title) of each picture


@dataclass
class Text:
    """Paragraphs."""

    kind: ClassVar[str] = "text"
    paragraphs: Sequence[str]


@dataclass
class Details:
    """Tables that the reader can unfold."""

    kind: ClassVar[str] = "details"
    summary: str
    elements: Sequence[Table]


Element = Table | Picture | Strip | Text | Details


@dataclass
class Section:
    title: str
    elements: Sequence[Element]


def write_page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a complete HTML page that loads no other files and contains no scripts."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("skipgs_plug.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.jinja").render(title=title, lead=lead, sections=sections) + "\n"
