"""Names, signatures and state keys that others rely on: a change here is a change for users."""

from __future__ import annotations

import inspect
import subprocess
import sys

import torch

import skipgs_plug
from skipgs_plug import SkipConfig, SkipGate
from skipgs_plug.core.policy import SkipPolicy

NAMES = {
    "AdapterMismatchError",
    "Decision",
    "GateOrderError",
    "SkipConfig",
    "SkipGSError",
    "SkipGate",
    "UnknownTrainerError",
    "register_adapter",
}

GATE = {
    "backward": "(self, loss: 'Any', view: 'Any', step: 'int', *, signal: 'Any' = None) -> 'bool'",
    "detach": "(self) -> 'None'",
    "load_state_dict": "(self, state: 'dict[str, Any]') -> 'None'",
    "notify_event": "(self, kind: 'str', step: 'int | None' = None) -> 'None'",
    "report": "(self) -> 'dict[str, Any]'",
    "scalars": "(self) -> 'dict[str, float]'",
    "state_dict": "(self) -> 'dict[str, Any]'",
    "stats": "(self) -> 'dict[str, Any]'",
    "step": "(self, optimizer: 'Any', *args: 'Any') -> 'bool'",
    "summary": "(self) -> 'str'",
    "update": "(self) -> 'None'",
    "verify": "(self) -> 'None'",
    "view_table": "(self) -> 'list[dict[str, Any]]'",
    "visible": "(self, mask: 'Tensor') -> 'Tensor'",
}
GATE_PROPERTIES = {"adapter", "config", "patched", "policy", "skipped", "trace"}

DEFAULTS = {
    "start_iter": None,
    "threshold": 0.0,
    "ema_decay": 0.95,
    "warmup": 500,
    "min_bwd_ratio": "auto",
    "enabled": True,
    "on_nonfinite": "skip",
    "pause_iters": None,
    "step_mode": "off",
    "step_trigger": "snr",
}


def test_top_level_names() -> None:
    assert set(skipgs_plug.__all__) == NAMES
    assert all(hasattr(skipgs_plug, name) for name in NAMES)


def test_errors_are_one_family() -> None:
    for name in NAMES:
        if name.endswith("Error"):
            assert issubclass(getattr(skipgs_plug, name), skipgs_plug.SkipGSError)


def test_gate_verbs_and_their_signatures() -> None:
    members = {n: m for n, m in vars(SkipGate).items() if not n.startswith("_")}
    assert {n: str(inspect.signature(m)) for n, m in members.items() if callable(m)} == GATE
    assert {n for n, m in members.items() if isinstance(m, property)} == GATE_PROPERTIES


def test_settings_and_their_defaults() -> None:
    assert SkipConfig().as_dict() == DEFAULTS


def test_policy_takes_the_authors_names() -> None:
    names = list(inspect.signature(SkipPolicy).parameters)
    assert names[:6] == ["start_iter", "threshold", "ema_decay", "warmup", "min_bwd_ratio", "enabled"]


def test_state_keys() -> None:
    gate = SkipGate(start_iter=0)
    gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
    state = gate.state_dict()
    assert set(state) == {"version", "policy", "stats", "accumulator", "non_finite_in_a_row", "clock", "step"}
    assert set(state["policy"]) == {"version", "means", "budget", "warmup_end", "pause_until", "events"}
    assert set(state["stats"]) == {"iterations", "backwards", "skips", "reasons", "events", "views"}
    assert state["version"] == state["policy"]["version"] == 2


def test_import_loads_nothing_heavy() -> None:
    code = (
        "import torch, sys; before = set(sys.modules); import skipgs_plug; "
        "new = {m.partition('.')[0] for m in set(sys.modules) - before}; "
        "print(new & {'warp', 'gsplat', 'pycolmap', 'matplotlib', 'tyro', 'PIL', 'torchvision', 'scipy'})"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "set()"


def test_the_rule_needs_no_torch() -> None:
    """Policy files import the standard library alone."""
    code = (
        "import sys, types, pathlib; root = pathlib.Path(sys.argv[1]); "
        "package = types.ModuleType('skipgs_plug'); package.__path__ = [str(root)]; "
        "sys.modules['skipgs_plug'] = package; import skipgs_plug.core.policy; "
        "print({'torch', 'numpy'} & set(sys.modules))"
    )
    root = skipgs_plug.__path__[0]
    output = subprocess.run([sys.executable, "-c", code, root], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "set()"
