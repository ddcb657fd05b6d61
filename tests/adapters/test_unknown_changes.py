"""Forks of trainer objects with a change of the model that their adapter does not know: named, and waited for."""

import importlib.util
import inspect
import re
import types

import pytest
from cases import SkipAlways
from lookalikes import edgs, faster_gs, fvdb, gsplat_runner, litegs, nerfstudio, step_trainer, threedgrut
from lookalikes.splats import new_log

from skipgs_plug import SkipGate
from skipgs_plug.adapters.loop_bounds import CallReader

TRIM = "def trim(self): self.prune_gaussians(0.01, self.values['opacity'])"
MODEL = ("ADAPTER, FIRST", f"class SplatModel(SplatModel):\n    {TRIM}\n\nADAPTER, FIRST")  # a model with this method


def unbounded(edits):
    """The same edits without the condition."""
    return [(old, re.sub(r"if [^:\n]*(?:30|, 6\)|< 6)[^:\n]*: ", "", new)) for old, new in edits]


# By adapter: look-alike, edits that call `trim` before iteration 30, and how the trainer is made.
FORKS = {
    "edgs": (
        edgs,
        [
            MODEL,
            ("    def prune(self):\n", "    def prune(self):\n        if self.gs_step < 30: self.gaussians.trim()\n"),
        ],
        lambda fork: fork.EDGSTrainer(),
    ),
    "faster_gs": (
        faster_gs,
        [
            MODEL,
            (
                "    @training_callback(start_iteration=30)\n",
                "    @training_callback()\n    def clean(self, iteration):\n"
                "        if iteration < 30: self.model.gaussians.trim()\n\n"
                "    @training_callback(start_iteration=30)\n",
            ),
        ],
        lambda fork: fork.FasterGSTrainer(),
    ),
    "3dgrut": (
        threedgrut,
        [
            (
                "    def post_optimizer_step(self, step):\n        if",
                "    def trim(self): pass\n\n    def post_optimizer_step(self, step):\n"
                "        if check_step_condition(step, 0, 30, 1): self.trim()\n        if",
            )
        ],
        lambda fork: fork.Trainer3DGRUT(),
    ),
    "fvdb": (
        fvdb,
        [
            ("    def reset_opacities(", "    def trim(self): pass\n\n    def reset_opacities("),
            (
                "                self.optimizer.step()\n",
                "                if self._global_step < 30: self.optimizer.trim()\n"
                "                self.optimizer.step()\n",
            ),
        ],
        lambda fork: fork.SceneOptimizationRunner(),
    ),
    "gsplat": (
        gsplat_runner,
        [
            (
                "    def step_post_backward(self, params, optimizers, state, step, info, packed=False):\n",
                "    def trim(self): pass\n\n"
                "    def step_post_backward(self, params, optimizers, state, step, info, packed=False):\n"
                "        if step < 30: self.trim()\n",
            )
        ],
        lambda fork: fork.Runner(fork.DefaultStrategy()),
    ),
    "nerfstudio": (
        nerfstudio,
        [
            (
                "    def step_post_backward(self, step):\n",
                "    def trim(self): pass\n\n    def step_post_backward(self, step):\n"
                "        if step < 30: self.trim()\n",
            )
        ],
        lambda fork: fork.Trainer().setup(),
    ),
    "litegs": (
        litegs,
        [
            (
                "    def step(self, optimizer, epoch):\n",
                "    def trim(self): pass\n\n    def step(self, optimizer, epoch):\n"
                "        if epoch < 6: self.trim()\n",
            )
        ],
        lambda fork: fork,
    ),
}
each = pytest.mark.parametrize("name", FORKS)


def forked(module, edits, folder):
    """The look-alike with these edits, imported from a file of its own."""
    source = inspect.getsource(module)
    for old, new in edits:
        assert source.count(old) == 1, old
        source = source.replace(old, new)
    path = folder / "fork_of_trainer.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location("fork_of_trainer", path)
    fork = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fork)
    fork.check_step_condition = lambda step, start, end, frequency: start <= step < end
    return fork


def gate_of(fork, make):
    """A detached gate of the fork, which has trained if its adapter needs that."""
    new_log()
    gate = SkipGate(make(fork), policy=SkipAlways())
    if gate.adapter.name == "litegs":
        fork.train()
    gate.detach()
    return gate


@each
def test_unknown_change_is_named_and_the_gate_begins_after_it(name, tmp_path):
    module, edits, make = FORKS[name]
    with pytest.warns(RuntimeWarning, match="trim") as said:
        gate = gate_of(forked(module, edits, tmp_path), make)
    sentences = [str(one.message) for one in said]
    assert gate.adapter.name == name and gate.config.start_iter == 30
    assert len(sentences) == 2
    assert gate.adapter.checked.partition(" (")[0] in sentences[0]
    assert sentences[0].endswith("Not recognised, and still executed in skipped iterations: trim().")
    assert sentences[1] == "The gate starts at iteration 30 instead of 20: the loop calls trim() until iteration 29."


@each
def test_unknown_change_without_an_end_is_named(name, tmp_path):
    module, edits, make = FORKS[name]
    with pytest.warns(RuntimeWarning, match=r"Not recognised, .*: trim\(\)\.") as said:
        gate = gate_of(forked(module, unbounded(edits), tmp_path), make)
    assert gate.config.start_iter == 20 and len(said) == 1


@each
def test_the_trainer_itself_is_known(name, recwarn):
    module, _, make = FORKS[name]
    assert gate_of(module, make).config.start_iter == 20
    assert not recwarn.list


def test_unknown_bound_of_a_wrapped_trainer_is_named_and_counts():
    trainer = step_trainer.make()
    trainer.trim_until_iter = 30
    with pytest.warns(RuntimeWarning, match=r"Not recognised: trim_until_iter\. The gate begins with iteration 31"):
        gate = SkipGate(trainer)
    gate.detach()
    assert gate.config.start_iter == 31


class Loop:
    """Functions to be read."""

    stop, lists = 12, types.SimpleNamespace(saves=[3, 17])

    def train(self, last):
        stop = int(self.stop) + 1
        for step in range(last):
            if step >= stop:
                continue
            self.inner(now=step)

    def inner(self, now):
        self.prune()
        if not now > 5 and self.lists:
            self.grow()
        elif now in self.lists.saves:
            self.save()

    def guarded(self, step):
        if step > 7 or step == 5:
            return
        self.prune()

    prune = grow = save = lambda self: None


def test_ends_of_calls_are_read_through_functions_guards_and_names():
    reader = CallReader()
    reader.trainer.add(Loop)
    reader.read(Loop().train, {"step"}, {})
    assert {name: reader.ends[name] for name in ("inner", "prune", "grow", "save")} == {
        "inner": 13,
        "prune": 13,
        "grow": 6,
        "save": 13,
    }
    guard = CallReader()
    guard.read(Loop().guarded, {"step"}, {})
    assert guard.ends["prune"] == 8
