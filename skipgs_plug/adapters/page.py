"""Make docs/adapters.md from the adapters' declarations: `python -m skipgs_plug.adapters.page`."""

from __future__ import annotations

import textwrap

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import builtin_adapters
from skipgs_plug.core.trainer_info import Densification

HEAD = """# Supported trainers

*Made by `python -m skipgs_plug.adapters.page`.*

In every trainer, only the training backward pass is gated. Learning rates, SH degree, view order, logging, evaluation,
saving, prunes and optimizer calls continue in skipped iterations. Views are known by image name. A gate that would
start while densification still reads gradients is refused.

A fork may be taken for its parent. So each adapter names unknown calls that change the model. The gate begins after
the last change, known or not, if conditions of the loop, or of functions that it calls, tell its end. If a loop moves
the model in skipped iterations, the gate is released (Inria's family, gsplat, nerfstudio, `step_trainer`).

With `share`, densification events are left out *by visits*, when the Gaussians were seen too seldom before them, or *by
iterations*, when fewer iterations ran before them than their thresholds count. All events are kept where each one adds
by a budget, a constant share or a resolution.

`skipgs-plug run NAME -- SCRIPT ...` takes the name, or `auto`, which finds it in the script. Scripts were
checked with `--cpu`; [examples/README.md](../examples/README.md) has the details.

The gate cannot attach to compiled trainers, whose backward pass never goes through Python: Brush (Rust), LichtFeld
Studio and OpenSplat (C++), Postshot (closed). Nor can it to forks whose loop is not in `training()`: 4DGaussians.
"""

# Effect of `share` on the densification events of a trainer, by their requirement (`Densification.needs`).
WITH_SHARE = {"visits": "By visits.", "iterations": "By iterations.", "nothing": "All events are kept."}

_WRAP = textwrap.TextWrapper(118, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def adapters_page() -> str:
    """Return the page: for each trainer, the first gated iteration, special behaviour, and the checked version."""
    parts = [HEAD]
    for adapter in builtin_adapters():
        entries = {
            "Gated": adapter.gated,
            "With `share`": adapter.with_share or WITH_SHARE.get(getattr(densification(adapter), "needs", ""), ""),
            "Also": adapter.left_alone,
            "Checked with": f"{adapter.checked}.",
        }
        lines = [_WRAP.fill(f"- **{what}.** {text}") for what, text in entries.items() if text]
        parts.append(f"## `{adapter.name}`: {adapter.project}\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def densification(adapter: type[AbstractAdapter]) -> Densification | None:
    """Return how the adapter declares densification events, if it does so without a trainer."""
    return getattr(adapter, "densification", None)


if __name__ == "__main__":
    print(adapters_page(), end="")
