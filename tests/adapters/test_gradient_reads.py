"""Code that reads gradients which a skipped iteration has not: the gate begins after it, or the run is refused."""

import pytest
from cases import SCRIPTS, SkipAlways
from lookalikes import edgs, faster_gs, fvdb, fvdb_frgs, gsplat_runner, litegs, nerfstudio, threedgrut
from lookalikes.splats import log, new_log
from test_unknown_changes import forked
from unknown_fork import TRAIN, GaussianModel, train

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError
from skipgs_plug.adapters.loop_bounds import READS_GRADIENT, CallReader

UNTIL_THE_END = r"its loop reads gradients \(grad\) until its end"
MODULES = {case.module.__name__.rpartition(".")[2]: case.module for case in SCRIPTS}
LOSS, BATCHES = "loss.backward()\n", "loss.backward(retain_graph=False)\n"
# By adapter: look-alike, its backward, and how the trainer is made.
OBJECTS = {
    "edgs": (edgs, LOSS, lambda fork: fork.EDGSTrainer()),
    "faster_gs": (faster_gs, LOSS, lambda fork: fork.FasterGSTrainer()),
    "3dgrut": (threedgrut, 'batch_losses["total_loss"].backward()\n', lambda fork: fork.Trainer3DGRUT()),
    "fvdb": (fvdb, BATCHES, lambda fork: fork.SceneOptimizationRunner()),
    "fvdb_frgs": (fvdb_frgs, BATCHES, lambda fork: fork.GaussianSplatReconstruction()),
    "litegs": (litegs, LOSS, lambda fork: fork),
    "nerfstudio": (nerfstudio, "self.grad_scaler.scale(loss).backward()\n", lambda fork: fork.Trainer().setup()),
    "gsplat": (gsplat_runner, f'{LOSS}            f"loss', lambda fork: fork.Runner(fork.DefaultStrategy())),
}


@pytest.mark.parametrize("settings", [{}, {"refine_share": 0.5}])
@pytest.mark.parametrize("name", MODULES)
def test_every_adapter_of_the_family_refuses_a_loop_that_reads_gradients_until_its_end(name, settings, tmp_path):
    read = "loss.backward()\n        log.norm = gaussians.values['xyz'].grad.norm()\n        "
    fork = forked(MODULES[name], [("loss.backward()\n        ", read)], tmp_path)
    new_log()
    with pytest.raises(AdapterMismatchError, match=UNTIL_THE_END), SkipGate(fork, **settings):
        fork.train()
    assert not log.backwards


@pytest.mark.parametrize("name", OBJECTS)
def test_adapters_of_trainer_objects_do_so_too(name, tmp_path):
    module, backward, make = OBJECTS[name]
    fork = forked(module, [(backward, f"log.norm = means.grad.norm(), {backward}")], tmp_path)
    new_log()
    with pytest.raises(AdapterMismatchError, match=UNTIL_THE_END), SkipGate(make(fork), policy=SkipAlways()):
        fork.train()
    assert not log.backwards


class Reading(GaussianModel):
    def add_densification_stats(self, *args):
        self.gathered += self.values["xyz"].grad.norm()

    def clip(self):
        self.values["xyz"].grad.clamp(-1, 1)


def reading(make, monkeypatch, call):
    """A fork that makes this call between its backward and its step."""
    step = "            gaussians.optimizer.step()\n"
    monkeypatch.setattr("unknown_fork.TRAIN", TRAIN.replace(step, f"            {call}\n{step}"))
    monkeypatch.setattr("unknown_fork.GaussianModel", Reading)
    return make()


@pytest.mark.filterwarnings(r"ignore:.*Not recognised.*clip\(\)")
@pytest.mark.parametrize("settings", [{"policy": SkipAlways()}, {"refine_share": 0.5}])
@pytest.mark.parametrize("call", ["gaussians.add_densification_stats()", "gaussians.clip()"])
def test_reads_in_methods_of_the_model_are_seen(call, settings, from_file, monkeypatch):
    bounded = reading(from_file, monkeypatch, f"if iteration < opt.prune_until_iter: {call}")
    with (
        pytest.warns(RuntimeWarning, match="the grad of a tensor until iteration 29"),
        SkipGate(bounded, **settings) as gate,
    ):
        train(bounded)
    assert gate.config.start_iter == 30 and gate.released is None
    whole = reading(from_file, monkeypatch, f"if iteration < opt.iterations: {call}")
    with pytest.raises(AdapterMismatchError, match=UNTIL_THE_END), SkipGate(whole, **settings):
        train(whole)


@pytest.mark.filterwarnings("ignore:The gate starts at iteration 30")
def test_a_start_before_the_last_read_is_refused(from_file, monkeypatch):
    fork = reading(from_file, monkeypatch, "if iteration < opt.prune_until_iter: gaussians.add_densification_stats()")
    with pytest.raises(SkipGSError, match="start_iter=25 is too early"), SkipGate(fork, start_iter=25):
        train(fork)


def test_a_run_that_ends_before_densification_is_not_refused(from_file, monkeypatch):
    fork = reading(from_file, monkeypatch, "if iteration < opt.densify_until_iter: gaussians.add_densification_stats()")
    with SkipGate(fork, policy=SkipAlways()) as gate:
        train(fork, densify_until_iter=50)
    assert gate.released is None and log.backwards == [*range(1, 41)]


def test_a_function_reads_the_gradients_of_its_own_backward():
    def score(values):
        values.sum().backward()
        return values.grad

    def early(values):
        found = values.grad.norm()
        values.sum().backward()
        return found

    class Model:
        def update(self, step):
            self.step = step
            if self.step < 12:
                self.norm = self.values.grad.norm()

    def ends(function, gated=()):
        reader = CallReader(["update"], gated)
        reader.trainer.add(function)
        reader.read(function, {"step"}, {})
        return reader.ends

    assert READS_GRADIENT not in ends(score)
    assert ends(score, ["score"])[READS_GRADIENT] is ends(early)[READS_GRADIENT] is None
    model = Model()

    def loop(step):
        model.update(step)

    assert ends(loop) == {"update": None, READS_GRADIENT: 12}


def test_a_question_for_one_gradient_answers_for_no_other():
    def asks(values, others):
        if values.grad is not None:
            log.norm = others.grad.norm()
        return values.grad

    def guarded(values, others):
        for value in values:
            if value.grad is None:
                continue
            log.norm = others.grad.norm()

    def beside(values, others):
        if values.grad is not None:
            log.norm = values.grad.norm()
        log.last = others.grad.norm()

    found = {}
    for function in (asks, guarded, beside):
        reader = CallReader()
        reader.trainer.add(function)
        reader.read(function, {"step"}, {})
        found[function] = READS_GRADIENT in reader.ends
    assert found == {asks: False, guarded: False, beside: True}
