"""The parts of a page, and the page made of them. The template escapes everything from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar


@dataclass
class Table:
    """A table whose first column heads its rows; `text` aligns the others left, else right."""

    kind: ClassVar[str] = "table"
    caption: str
    heading: Sequence[str]
    rows: Sequence[Sequence[Any]]
    text: bool = False


@dataclass
class Picture:
    """A picture as a data URI; the caption also describes it. A `wide` one is scrolled on small screens."""

    kind: ClassVar[str] = "picture"
    source: str
    caption: str
    wide: bool = False


@dataclass
class Strip:
    """Pictures side by side, each with a title, or below each other on small screens."""

    kind: ClassVar[str] = "strip"
    caption: str
    pictures: Sequence[tuple[str, str]]  # data URI, title


@dataclass
class Text:
    """Paragraphs."""

    kind: ClassVar[str] = "text"
    paragraphs: Sequence[str]


@dataclass
class Details:
    """Blocks that are folded up."""

    kind: ClassVar[str] = "details"
    summary: str
    blocks: Sequence[Table]


Block = Table | Picture | Strip | Text | Details


@dataclass
class Section:
    title: str
    blocks: Sequence[Block]


def write_page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a whole page of HTML; it loads nothing and holds no script."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("skipgs_plug.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.jinja").render(title=title, lead=lead, sections=sections) + "\n"
