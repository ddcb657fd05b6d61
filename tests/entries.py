"""Entry points of the gate's own code that every kind of loop reaches: tests let each of them fail."""

from skipgs_plug.core.engine import Engine
from skipgs_plug.core.policy import SkipPolicy

ENTRIES = {
    "iteration": (Engine, "open_iteration"),
    "backward": (Engine, "gate"),
    "decision": (SkipPolicy, "decide"),
    "event": (Engine, "notify_event"),
    "graph": (Engine, "free_skipped"),
}
