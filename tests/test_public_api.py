"""Names, signatures and state keys that others rely on: a change here is a change for users."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest
import torch

import skipgs_plug
from skipgs_plug import SkipConfig, SkipGate, adapters
from skipgs_plug.adapters import AbstractAdapter, Hooks, TrainerInfo
from skipgs_plug.core.policy import Policy, SkipPolicy

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
    "iterations": (
        "(self, numbers: 'range', *, always: 'Iterable[int] | None' = None, "
        "views: 'Iterable[Any] | None' = None, "
        "events: 'Iterable[int] | None' = None, resets: 'Iterable[int] | None' = None) -> 'LoopRange'"
    ),
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
}
GATE_PROPERTIES = {
    "script_globals",
    "adapter",
    "config",
    "patched",
    "policy",
    "released",
    "skipped",
    "trace",
    "trained",
}

ADAPTER = {
    "attach": "(self, hooks: 'Hooks') -> 'None'",
    "attach_on_call": "(self, hooks: 'Hooks', owner: 'Any', method: 'str') -> 'None'",
    "attach_script": "(self, hooks: 'Hooks') -> 'None'",
    "matches": "(trainer: 'Any') -> 'bool'",
    "mismatch": "(self, expected: 'str') -> 'AdapterMismatchError'",
    "must_run": "(self, step: 'int') -> 'bool'",
    "optimizers": "(self) -> 'Iterable[torch.optim.Optimizer]'",
    "recognises_script": "(code: 'LoopCode') -> 'bool'",
    "stand_ins_for": "(command: 'Sequence[str]') -> 'str'",
    "timing": "(self) -> 'Times | None'",
}
HOOKS = {
    "always": "(self, always: 'Always') -> 'None'",
    "backward": (
        "(self, loss: 'torch.Tensor', run: 'Callable[[], Any]', view: 'Any' = None, keeps_graph: 'bool' = False) "
        "-> 'Any'"
    ),
    "before": "(self, owner: 'Any', name: 'str', call: 'Callable[..., Any]') -> 'None'",
    "check_drift": "(self, optimizers: 'Optimizers') -> 'None'",
    "event": "(self, kind: 'str') -> 'None'",
    "events": "(self, owner: 'Any', *names: 'str') -> 'None'",
    "gate_tensor_backward": "(self, *callers: 'str') -> 'None'",
    "guarded": "(self) -> 'AbstractContextManager[None]'",
    "iteration": "(self, step: 'int') -> 'None'",
    "loop": (
        "(self, names: 'dict[str, Any]', *functions: 'str', always: 'Always | None' = None, "
        "pure: 'Iterable[str]' = (), densification: 'Densification | None' = None, "
        "known: 'Known | None' = None) -> 'None'"
    ),
    "number": "(self, counted: 'int') -> 'int'",
    "on_detach": "(self, label: 'str', undo: 'Callable[[], None]') -> 'None'",
    "own_loop": "(self, owner: 'Any', name: 'str', always: 'Always | None' = None) -> 'None'",
    "optimizer_names": "(self, named: 'Named') -> 'None'",
    "release": "(self, reason: 'str') -> 'None'",
    "require": "(self, number: 'int') -> 'None'",
    "ready": "(self, info: 'TrainerInfo') -> 'None'",
    "restore": "(self) -> 'None'",
    "signal": "(self, value: 'float | torch.Tensor') -> 'None'",
    "suppress_on_skip": "(self, owner: 'Any', *names: 'str') -> 'None'",
    "verify": "(self) -> 'None'",
    "view": "(self, key: 'Any') -> 'None'",
    "wrap": "(self, owner: 'Any', name: 'str', around: 'Around') -> 'None'",
}
FACTS = (
    "(start_iter: 'int | None', *, settled_iter: 'int | None' = None, view_names: 'Iterable[str] | None' = None, "
    "epoch: 'int | None' = None, max_steps: 'int | None' = None, world_size: 'int | None' = None, "
    "gradients_read_until: 'int | None' = None, accumulates: 'bool' = False, "
    "steps_each: 'bool' = False, "
    "densification: 'Densification | None' = None, "
    "photographs: 'Callable[[], Iterable[Tensor]] | None' = None, "
    "slow_positions: 'bool' = False, positions_rate: 'float' = 0.0, random_points: 'bool | None' = None, "
    "defaults: 'Mapping[str, Any]' = <factory>) -> None"
)
POLICY = {
    "decide": "(self, view: 'Hashable', loss: 'float', step: 'int') -> 'Decision'",
    "known_ahead": "(self, view: 'Hashable', step: 'int') -> 'bool | None'",
    "load_state_dict": "(self, state: 'dict[str, Any]') -> 'None'",
    "mean": "(self, view: 'Hashable') -> 'float | None'",
    "notify_event": "(self, step: 'int', n_views: 'int') -> 'None'",
    "overrule": "(self, own: 'Decision', answer: 'Decision') -> 'None'",
    "state_dict": "(self) -> 'dict[str, Any]'",
}

DEFAULTS = {
    "start_iter": None,
    "threshold": 0.0,
    "ema_decay": 0.95,
    "warmup": 500,
    "min_bwd_ratio": "auto",
    "enabled": True,
    "on_nonfinite": "skip",
    "pause_iters": None,
    "share": None,
    "grow_share": None,
    "refine_share": None,
    "half_size": None,
    "max_gaussians": None,
    "always": None,
    "tolerance": 0.05,
    "compensate": None,
    "rate_peak": None,
}


def test_top_level_names() -> None:
    assert set(skipgs_plug.__all__) == NAMES
    assert all(hasattr(skipgs_plug, name) for name in NAMES)


def test_errors_are_one_family() -> None:
    for name in NAMES:
        if name.endswith("Error"):
            assert issubclass(getattr(skipgs_plug, name), skipgs_plug.SkipGSError)


def signatures(cls: type) -> dict[str, str]:
    """Of everything public that can be called."""
    names = [name for name in dir(cls) if not name.startswith("_") and callable(getattr(cls, name))]
    return {name: str(inspect.signature(getattr(cls, name))) for name in names}


def properties(cls: type) -> set[str]:
    return {name for name in dir(cls) if isinstance(getattr(cls, name), property) and not name.startswith("_")}


def test_gate_verbs_and_their_signatures() -> None:
    assert signatures(SkipGate) == GATE
    assert properties(SkipGate) == GATE_PROPERTIES


def test_what_adapters_are_written_with() -> None:
    assert set(adapters.__all__) == {"AbstractAdapter", "Densification", "Hooks", "TrainerInfo", "register_adapter"}
    assert signatures(AbstractAdapter) == ADAPTER
    assert AbstractAdapter.__abstractmethods__ == {"attach", "matches"}
    assert set(AbstractAdapter.__annotations__) == {
        "name",
        "checked",
        "project",
        "gated",
        "left_alone",
        "with_share",
        "saved_state",
        "output_folder",
        "script",
        "replaced",
        "stand_ins",
    }
    assert signatures(Hooks) == HOOKS
    asked = {"at_half_size", "gap", "lengthens_steps", "may_halve", "patched", "released", "state", "trained"}
    assert properties(Hooks) == asked
    assert str(inspect.signature(TrainerInfo)) == FACTS
    assert str(inspect.signature(adapters.register_adapter)) == (
        "(adapter: 'type[AbstractAdapter]') -> 'type[AbstractAdapter]'"
    )


def test_names_of_earlier_versions_still_work_and_say_their_new_ones() -> None:
    with pytest.warns(DeprecationWarning, match="TrainerFacts is called TrainerInfo now"):
        from skipgs_plug.adapters import TrainerFacts
    assert TrainerFacts is TrainerInfo
    with pytest.raises(AttributeError, match="has no attribute 'Facts'"):
        adapters.Facts  # noqa: B018 - the access is what is tested


def test_what_policies_are_written_with() -> None:
    assert signatures(Policy) == POLICY
    assert properties(Policy) == {"floor", "start_iter"}
    assert Policy.__abstractmethods__ == {"decide", "load_state_dict", "notify_event", "state_dict"}


def test_settings_and_their_defaults() -> None:
    assert SkipConfig().as_dict() == DEFAULTS


def test_policy_takes_the_authors_names() -> None:
    names = list(inspect.signature(SkipPolicy).parameters)
    assert names[:6] == ["start_iter", "threshold", "ema_decay", "warmup", "min_bwd_ratio", "enabled"]


def test_a_policy_takes_every_setting_that_is_its_own() -> None:
    settings = SkipConfig(3, 0.1, 0.5, 7, 0.25, False, pause_iters=9)
    ours, theirs = SkipPolicy.from_config(settings), SkipPolicy(3, 0.1, 0.5, 7, 0.25, False, 9)
    for name in ("start_iter", "enabled", "floor", "_ceiling", "_warmup"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert ours.means._decay == theirs.means._decay == 0.5
    assert ours.pause._iters == theirs.pause._iters == 9


def test_state_keys() -> None:
    gate = SkipGate(start_iter=0)
    gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
    state = gate.state_dict()
    gate = {"version", "policy", "stats", "non_finite_in_a_row", "clock", "step", "pace", "visibility", "size_bound"}
    assert set(state) == gate
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
