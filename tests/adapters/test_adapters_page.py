"""docs/adapters.md agrees with the adapters."""

from pathlib import Path

import pytest

from skipgs_plug.adapters.page import adapters_page
from skipgs_plug.adapters.registry import BUILTIN, builtin_adapters

DOCS = Path(__file__).parents[2] / "docs"


def test_page_is_up_to_date():
    assert (DOCS / "adapters.md").read_text() == adapters_page(), (
        "run: python -m skipgs_plug.adapters.page > docs/adapters.md"
    )


@pytest.mark.parametrize("adapter", list(builtin_adapters()), ids=list(BUILTIN))
def test_every_adapter_declares_itself(adapter):
    # The adapter itself has these attributes, not only its base class.
    assert all(name in vars(adapter) for name in ("project", "gated", "checked"))
    assert adapter.gated.endswith(".") and adapter.left_alone.endswith(".")
    assert adapter.name == "reference" or "](https://" in adapter.project
