"""Changes that a fork makes later than its parent: the gate begins after them, wherever the loop makes them."""

import sys

import pytest
from cases import SCRIPTS, SkipAlways
from lookalikes import gsplat_runner, lightgaussian_distill, nerfstudio, threedgrut
from lookalikes.splats import new_log
from test_unknown_changes import forked, gate_of
from unknown_fork import train, unknown_fork

from skipgs_plug import SkipGate

LATE = 55  # an iteration after the start of every look-alike's gate
MODULES = {case.module.__name__.rpartition(".")[2]: case.module for case in SCRIPTS}


@pytest.mark.parametrize("name", MODULES)
def test_a_known_change_of_a_fork_is_waited_for_by_every_adapter(name, tmp_path):
    module = MODULES[name]
    model = "student_gaussians" if module is lightgaussian_distill else "gaussians"
    late = f"loss.backward()\n        if iteration == {LATE}: {model}.training_setup(opt)\n"
    fork = forked(module, [("loss.backward()\n        ", f"{late}        ")], tmp_path)
    new_log()
    with SkipGate(fork) as gate, pytest.warns(RuntimeWarning, match=rf"training_setup\(\) until iteration {LATE}"):
        fork.train(last=module.FIRST)
    assert gate.adapter.name == module.ADAPTER and gate.config.start_iter == LATE + 1


PRUNE = "gaussians.prune_points(torch.zeros(30, dtype=torch.bool))"


BEFORE = f"""pruned, stages = False, {{24: "a", 28: "b"}}
    hooks = [lambda step: {PRUNE} if step < 30 else None]
    trimmer, trim = Trimmer(gaussians, opt), gaussians.prune_points
    trim_twice = functools.partial(trim_at, gaussians, others=(26,), opt=opt)"""
FUNCTIONS = """
import functools

def is_due(step, opt):
    if step > opt.prune_until_iter: return False
    return step % 3 == 0

def trim_at(gaussians, step, opt, others):
    if step in others or step == opt.prune_until_iter: gaussians.prune_points(torch.zeros(30, dtype=torch.bool))

class Trimmer:
    def __init__(self, gaussians, opt): self.gaussians, self.stages = gaussians, {24, 28}
    def __call__(self, step):
        if step in self.stages: self.gaussians.prune_points(torch.zeros(30, dtype=torch.bool))
"""


@pytest.mark.parametrize(
    ("extra", "start"),
    [
        (f"late = iteration in (24, 28)\n            if late: {PRUNE}", 29),
        (f"late, due = iteration == opt.prune_until_iter, True\n            if late and due: {PRUNE}", 31),
        (f"end = opt.prune_until_iter if opt.longer else 5\n            if iteration < end: {PRUNE}", 30),
        (f"end = 5 if opt.longer else opt.prune_until_iter\n            if iteration < end: {PRUNE}", 20),
        (f"step = iteration + 1\n            if step <= opt.prune_until_iter: {PRUNE}", 30),
        (f"if iteration not in (24,): continue\n            {PRUNE}", 25),
        (f"if opt.pruned_late and iteration < 30: {PRUNE}", 20),
        (f"if not opt.pruned_late and iteration < 30: {PRUNE}", 30),
        (f"if not opt.pruned_late: continue\n            {PRUNE}", 20),
        (f"if iteration <= getattr(opt, 'prune_until_iter'): {PRUNE}", 31),
        (f"if getattr(opt, 'pruned_late', True) and iteration < 30: {PRUNE}", 20),
        (f"if getattr(opt, 'absent', False) and iteration < 30: {PRUNE}", 20),
        (f"if getattr(opt, 'absent', True) and iteration < 30: {PRUNE}", 30),
        (f"if iteration < getattr(opt, 'moved', 25): {PRUNE}\n            opt.moved = 25", 20),
        (f"end = last = opt.prune_until_iter\n            if iteration < last: {PRUNE}", 30),
        (f"rounds, rest = divmod(opt.prune_until_iter, 7)\n            if iteration < 7 * rounds: {PRUNE}", 28),
        (f"if opt.changed_late and iteration < 30: {PRUNE}\n            opt.changed_late = True", 30),
        (f"if pruned and iteration < 30: {PRUNE}\n            pruned = iteration > 3", 30),
        (f"if iteration < opt.iterations: {PRUNE}", 20),  # it prunes until the end, and each prune pauses the gate
        (f"if iteration in range(22, 28, 2): {PRUNE}", 27),
        (f"if stages.get(iteration): {PRUNE}", 29),
        (f"if is_due(iteration, opt): {PRUNE}", 31),
        (f"{PRUNE} if iteration <= opt.prune_until_iter else None", 31),
        (f"iteration <= opt.prune_until_iter and {PRUNE}", 31),
        (f"while iteration < opt.prune_until_iter:\n                {PRUNE}\n                break", 30),
        (f"match iteration:\n                case 22 | 26: {PRUNE}", 27),
        (f"match iteration:\n                case 22 | _: {PRUNE}", 20),
        (f"match iteration:\n                case n if n < opt.prune_until_iter: {PRUNE}", 30),
        ("for hook in hooks: hook(iteration)", 30),
        ("trimmer(iteration)", 29),
        ("trim_twice(iteration)", 31),
        ("if iteration < 30: trim(torch.zeros(30, dtype=torch.bool))", 30),
        (f"if (step := iteration) < 30 and step % 2: {PRUNE}", 30),
    ],
)
def test_bounds_are_read_through_names_and_options(extra, start, tmp_path):
    fork = unknown_fork(extra=extra, before=BEFORE, helper=FUNCTIONS, file=tmp_path / "train.py")
    with SkipGate(fork, policy=SkipAlways()) as gate:
        if start > 20:
            with pytest.warns(RuntimeWarning, match=rf"prune_points\(\) until iteration {start - 1}"):
                train(fork, longer=True, pruned_late=False, changed_late=False)
        else:
            train(fork, longer=True, pruned_late=False, changed_late=False)
    assert gate.config.start_iter == start


HELPERS = """
def maybe_prune(gaussians, step, mask):
    if step == 29:
        gaussians.prune_points(mask)

class Pruner:
    last = 29

    def step(self, gaussians, now):
        if now <= self.last:
            gaussians.prune_points(None)
"""
NONE = "torch.zeros(30, dtype=torch.bool)"


@pytest.mark.parametrize(
    ("folder", "extra", "start"),
    [
        ("", f"maybe_prune(gaussians, iteration, {NONE})", 30),
        ("", "if iteration > 100: pruner.step(gaussians, iteration)", 30),
        (
            "",
            "if iteration > 100: fork_helpers.Pruner().step(gaussians, iteration)",
            20,
        ),  # the loop makes the object, so its method is not known
        ("site-packages", f"maybe_prune(gaussians, iteration, {NONE})", 20),
    ],
)
def test_imported_helpers_of_the_same_folder_are_read(folder, extra, start, tmp_path, monkeypatch):
    place = tmp_path / folder
    (place / "fork_helpers").mkdir(parents=True)
    (place / "fork_helpers" / "__init__.py").write_text(HELPERS)
    monkeypatch.syspath_prepend(place)
    monkeypatch.delitem(sys.modules, "fork_helpers", raising=False)
    imports = "\nimport fork_helpers\nfrom fork_helpers import Pruner, maybe_prune\n"
    fork = unknown_fork(extra=extra, before="pruner = Pruner()", file=tmp_path / "train.py", helper=imports)
    with SkipGate(fork, policy=SkipAlways()) as gate:
        if start > 20:
            with pytest.warns(RuntimeWarning, match=r"prune_points\(\) until iteration 29"):
                train(fork)
        else:
            train(fork)
    assert gate.config.start_iter == start


METHODS = """    def maybe_trim(self, step):
        if step == 29:
            self.trim_now()

    def trim_now(self):
        self.{strategy}.trim()

"""
TRIM = "    def trim(self): pass\n\n"
# Look-alikes of trainer objects whose loop calls a method that changes the model in iteration 29.
OBJECTS = {
    "gsplat": (
        gsplat_runner,
        [
            ("    def step_pre_backward(self, params", f"{TRIM}    def step_pre_backward(self, params"),
            ("    def number_of(", METHODS.format(strategy="cfg.strategy") + "    def number_of("),
            ('            f"loss=', '            self.maybe_trim(step)\n            f"loss='),
        ],
        lambda fork: fork.Runner(fork.DefaultStrategy()),
    ),
    "3dgrut": (
        threedgrut,
        [
            (
                "    def post_optimizer_step(self, step):\n        if",
                f"{TRIM}    def post_optimizer_step(self, step):\n        if",
            ),
            ("    def run_training(", METHODS.format(strategy="strategy") + "    def run_training("),
            ('_loss"].backward()\n', '_loss"].backward()\n        self.maybe_trim(global_step)\n'),
        ],
        lambda fork: fork.Trainer3DGRUT(),
    ),
    "nerfstudio": (
        nerfstudio,
        [
            ("    def step_post_backward(self, step)", f"{TRIM}    def step_post_backward(self, step)"),
            ("    def train(self", METHODS.format(strategy="pipeline.model") + "    def train(self"),
            ("scale(loss).backward()\n", "scale(loss).backward()\n        self.maybe_trim(step)\n"),
        ],
        lambda fork: fork.Trainer().setup(),
    ),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_methods_of_a_trainer_object_are_read(name, tmp_path):
    module, edits, make = OBJECTS[name]
    with pytest.warns(RuntimeWarning, match=r"trim\(\)"):
        gate = gate_of(forked(module, edits, tmp_path), make)
    assert gate.adapter.name == name and gate.config.start_iter == 30


def test_methods_of_a_users_subclass_are_read(tmp_path):
    module, edits, _ = OBJECTS["gsplat"]
    fork = forked(module, [(old, new.replace("step == 29", "step == 1")) for old, new in edits], tmp_path)

    class Mine(fork.Runner):
        def maybe_trim(self, step):
            if step == 29:
                self.trim_now()

    with pytest.warns(RuntimeWarning, match=r"trim\(\)"):
        gate = gate_of(fork, lambda fork: Mine(fork.DefaultStrategy()))
    assert gate.config.start_iter == 30
