"""docs/adapters.md, made of what the adapters say of themselves: `python -m skipgs_plug.adapters.page`."""

from __future__ import annotations

import textwrap

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import builtin_adapters
from skipgs_plug.core.facts import Densification

HEAD = """# Trainers

*Made by `python -m skipgs_plug.adapters.page > docs/adapters.md` from the adapters' own declarations; a test compares.*

In every trainer only the training backward is gated. Learning rates, SH degree, view order, logging, evaluation,
saving, prunes and optimizer calls go on in skipped iterations; an optimizer without a gradient does nothing by itself.
Views are known by image name. A gate that would start while densification still reads gradients is refused.

`skipgs-plug run NAME -- SCRIPT ...` takes the name, or `auto`, which reads the script and finds it. How each was
checked beyond its last line stands in [examples/README.md](../examples/README.md).

Trainers with a compiled core offer no place to attach to, since loss and backward never pass through Python: Brush
(Rust), LichtFeld Studio and OpenSplat (C++) and Postshot (closed). The gate cannot be attached to them.
"""

# What `share` does to the densification events of a trainer, by what they need (`Densification.needs`).
THINNED = {
    "visits": "Densification events wait until Gaussians have been seen often enough since the one before.",
    "iterations": "Densification events keep the number of iterations behind them that their thresholds count.",
    "nothing": "All densification events are kept: each adds by a budget, a constant share or a resolution.",
}

_WRAP = textwrap.TextWrapper(118, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def adapters_page() -> str:
    """The page: for each trainer what is gated, from when on, what is left alone, and with what it was checked."""
    parts = [HEAD]
    for adapter in builtin_adapters():
        facts = {
            "Gated": adapter.gated,
            "With `share`": adapter.thinned or THINNED.get(getattr(densification(adapter), "needs", ""), ""),
            "Beside that": adapter.left_alone,
            "Checked with": f"{adapter.checked}.",
        }
        lines = [_WRAP.fill(f"- **{what}.** {text}") for what, text in facts.items() if text]
        parts.append(f"## `{adapter.name}`: {adapter.project}\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def densification(adapter: type[AbstractAdapter]) -> Densification | None:
    """How the adapter declares densification events, where it does so without a trainer."""
    return getattr(adapter, "densification", None)


if __name__ == "__main__":
    print(adapters_page(), end="")
