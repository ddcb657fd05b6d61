"""How the tests look into a page with a browser."""

from __future__ import annotations

import re

# The script is added to a copy of the page. The page itself holds no script.
COUNT_IMAGES = """<script>addEventListener("load", () => {
  const images = [...document.images];
  document.body.dataset.images = images.length;
  document.body.dataset.decoded = images.filter(i => i.complete && i.naturalWidth > 0).length;
});</script>"""


def body_count(dom: str, name: str) -> int:
    found = re.search(rf'<body[^>]* data-{name}="(\d+)"', dom)
    assert found, f"the browser did not report {name}"
    return int(found.group(1))
