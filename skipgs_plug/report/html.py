"""The few pieces of HTML that a page is made of; everything from outside is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

CSS = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 78rem; margin: 2rem auto;
  padding: 0 1.25rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; }
h2 { font-size: 1.25rem; margin-top: 2.5rem; padding-top: 1rem; border-top: 1px solid #d0d7de; }
h3 { font-size: 1rem; margin-top: 1.6rem; }
p.lead { color: #57606a; margin-top: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; margin: .8rem 0; }
caption { text-align: left; font-weight: 600; padding-bottom: .3rem; }
th, td { padding: .3rem .5rem; border-bottom: 1px solid #eaeef2; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid #afb8c1; vertical-align: bottom; }
tbody th { font-weight: 600; }
table.text th, table.text td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
figure { margin: 1.4rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption { color: #57606a; font-size: .875rem; }
details { margin: 1rem 0; }
summary { cursor: pointer; }
"""


def document(title: str, lead: str, body: Sequence[str]) -> str:
    """Return a whole page; it loads nothing."""
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # Without an icon of its own a page makes the browser ask its server for one.
        f'<link rel="icon" href="data:,">\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n'
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>\n'
        + "\n".join(body)
        + "\n</main>\n</body>\n</html>\n"
    )


def table(caption: str, heading: Sequence[str], rows: Sequence[Sequence[Any]], text: bool = False) -> str:
    """Return a table whose first column heads its rows; `text` aligns the others left, else right."""
    head = "".join(f'<th scope="col">{escape(str(cell))}</th>' for cell in heading)
    body = "\n".join(
        f'<tr><th scope="row">{escape(str(row[0]))}</th>'
        + "".join(f"<td>{escape(str(cell))}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    kind = ' class="text"' if text else ""
    return (
        f'<div class="scroll"><table{kind}><caption>{escape(caption)}</caption>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def picture(source: str, alt: str, width: int | None = None) -> str:
    """Return an inlined picture; `alt` is its caption too."""
    size = f' style="width:{width}px"' if width else ""
    text = escape(alt)
    return f'<figure><img src="{source}" alt="{text}"{size}><figcaption>{text}</figcaption></figure>'


def paragraphs(sentences: Sequence[str]) -> str:
    return "\n".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)


def details(summary: str, inner: str) -> str:
    return f"<details><summary>{escape(summary)}</summary>\n{inner}\n</details>"
