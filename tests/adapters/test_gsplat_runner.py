"""gsplat's Runner: MCMC's noise, batches, processes, and the script that builds it."""

import functools
import os
import sys
import types

import pytest
import torch
from cases import RULE, SkipAlways, gsplat, run
from lookalikes.gsplat_runner import DefaultStrategy, HeadRunner, MCMCStrategy, Runner
from lookalikes.splats import NAMES, log, new_log

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError
from skipgs_plug.adapters.gsplat_strategy import iterations_that_run, strategy_events
from skipgs_plug.adapters.registry import find_script_adapter
from skipgs_plug.core.errors import UnknownTrainerError

MCMC = gsplat("mcmc", Runner, MCMCStrategy)


def test_noise_comes_with_the_gradient_step_only():
    gated, gate = run(MCMC, **RULE)
    skipped = {row.step for row in gate.trace if row.skip}
    moved = {i for i in range(59) if not torch.equal(gated.values[i][0], gated.values[i + 1][0])}
    assert skipped and moved == set(range(59)) - skipped


def test_gate_started_while_mcmc_relocates_forces_those_iterations():
    gated, gate = run(MCMC, start_iter=8, policy=SkipAlways(), record_trace=True)
    assert [row.step for row in gate.trace if not row.skip] == [10, 15]
    assert [step for step, kind, _ in gated.structure if kind == "relocate"] == [5, 10, 15]


def test_default_strategy_reads_gradients_so_that_an_early_start_is_refused():
    with pytest.raises(SkipGSError, match="start_iter=8 is too early: up to iteration 20"):
        SkipGate(Runner(DefaultStrategy()), start_iter=8)


def test_batches_have_one_key():
    _, gate = run(gsplat("batch", HeadRunner, DefaultStrategy, batch_size=2), **RULE)
    assert {row.view for row in gate.trace} == {"batch"}


def test_views_are_named_by_index_without_image_names():
    runner = Runner(DefaultStrategy())
    del runner.parser.image_names
    with SkipGate(runner, **RULE) as gate:
        new_log()
        runner.train()
    assert {row.view for row in gate.trace} == {str(i) for i in range(len(NAMES))}


def test_other_runner_of_the_same_strategy_is_left_alone():
    runner, other = Runner(DefaultStrategy()), Runner(DefaultStrategy())
    with SkipGate(runner) as gate:
        new_log()
        other.train(last=3)
        assert log.backwards == [0, 1, 2, 3] and gate.report()["iterations"] == 0


def test_several_processes_without_a_group_are_refused():
    with pytest.raises(SkipGSError, match=r"2 processes train together, but torch\.distributed is not initialised"):
        SkipGate(Runner(DefaultStrategy(), world_size=2))


def test_renamed_attribute_names_what_was_expected_and_where():
    runner = Runner(DefaultStrategy())
    del runner.trainset
    with pytest.raises(AdapterMismatchError, match=r"Runner with trainset, as in nerfstudio-project/gsplat v1\.5\.3"):
        SkipGate(runner, adapter="gsplat")


def test_a_strategy_elsewhere_than_in_the_configuration_is_a_mismatch():
    runner = Runner(DefaultStrategy())
    del runner.cfg.strategy  # before gsplat 1.3, the Runner itself had one
    with pytest.raises(AdapterMismatchError, match=r"Runner with cfg\.strategy, as in"):
        SkipGate(runner, adapter="gsplat")


@pytest.fixture
def gsplat_module(monkeypatch):
    """`gsplat.distributed` with upstream's `cli`: several devices mean several processes."""
    module = types.ModuleType("gsplat.distributed")
    module.devices = 1

    def _distributed_worker(world_rank, world_size, fn, args):
        return fn(world_rank, world_rank, world_size, args)

    def cli(fn, args, verbose=False):
        worker, n = module._distributed_worker, module.devices
        if n > 1:
            return torch.multiprocessing.spawn(worker, args=(n, fn, args), nprocs=n, join=False)
        return worker(0, 1, fn=fn, args=args)

    module.cli, module._distributed_worker = cli, _distributed_worker
    monkeypatch.setitem(sys.modules, "gsplat.distributed", module)
    return module


def script():
    """Run simple_trainer.py's own steps, in a namespace of its own."""
    names = {"Runner": type("Runner", (Runner,), {}), "DefaultStrategy": DefaultStrategy}
    code = """
from gsplat.distributed import cli
def main(local_rank, world_rank, world_size, cfg):
    runner = Runner(DefaultStrategy(), world_size=world_size)
    runner.train()
cli(main, None, verbose=True)
"""
    exec(code, names)
    return names


def test_script_is_reached_through_its_launcher(gsplat_module):
    new_log()
    with SkipGate(adapter="gsplat", **RULE) as gate:
        names = script()
    gate.verify()
    assert gate.report()["iterations"] == 60 and gate.report()["backwards_skipped"] > 0
    assert gate.adapter.output_folder == os.path.abspath("output")
    assert not hasattr(names["Runner"].train, "__skipgs_plug__") and not hasattr(
        gsplat_module._distributed_worker, "__skipgs_plug__"
    )


def test_a_runner_of_a_derived_class_with_all_of_its_own_is_reached(gsplat_module):
    """As BAD-Gaussians' script for gsplat has: it imports the Runner, and calls none of its methods."""
    parent = type("Runner", (Runner,), {})
    own = type("Deblur", (parent,), {"__init__": Runner.__init__, "train": Runner.train})
    new_log()
    with SkipGate(adapter="gsplat", **RULE) as gate:
        names = {"Runner": parent, "Deblur": own, "DefaultStrategy": DefaultStrategy}
        exec("def main(local_rank, world_rank, world_size, cfg):\n    Deblur(DefaultStrategy()).train()\n", names)
        gsplat_module.cli(names["main"], None)
    gate.verify()
    assert gate.report()["iterations"] == 60 and gate.report()["backwards_skipped"] > 0
    assert not any(hasattr(kind.__init__, "__skipgs_plug__") for kind in (parent, own))


def test_a_function_with_some_arguments_given_is_reached(gsplat_module):
    new_log()
    names = {"Runner": type("Runner", (Runner,), {}), "DefaultStrategy": DefaultStrategy}
    exec("def main(quick, local_rank, world_rank, world_size, cfg):\n    Runner(DefaultStrategy()).train()\n", names)
    with SkipGate(adapter="gsplat", **RULE) as gate:
        gsplat_module.cli(functools.partial(names["main"], True), None)
    assert gate.report()["iterations"] == 60


def test_a_script_that_starts_its_function_itself_is_refused_with_its_first_backward(gsplat_module):
    new_log()
    names = {"Runner": type("Runner", (Runner,), {}), "DefaultStrategy": DefaultStrategy}
    sentence = r"trains without a call of gsplat\.distributed\.cli\(\)"
    with pytest.raises(AdapterMismatchError, match=sentence), SkipGate(adapter="gsplat"):
        exec("Runner(DefaultStrategy()).train()", names)


def test_a_second_start_releases_the_gate_with_one_sentence(gsplat_module):
    new_log()
    second = pytest.warns(RuntimeWarning, match="a second training run begins in this process")
    with second as said, SkipGate(adapter="gsplat", **RULE) as gate:
        gsplat_module.cli(script()["main"], None)
    assert len(said) == 1 and gate.report()["iterations"] == 60


def test_a_script_that_trains_without_the_launcher_is_refused_with_its_first_backward(monkeypatch):
    """As gsplat's own scripts before 1.2 and simple_trainer_2dgs.py do, if a user names the adapter for them."""
    monkeypatch.delitem(sys.modules, "gsplat.distributed", raising=False)
    weight = torch.ones(1, requires_grad=True)
    names = {"weight": weight}
    exec("def train():\n    (2 * weight).sum().backward()\n", names)
    sentence = r"trains without a module gsplat\.distributed"
    with pytest.raises(AdapterMismatchError, match=sentence), SkipGate(adapter="gsplat"):
        names["train"]()
    assert weight.grad is None
    with SkipGate(adapter="gsplat", enabled=False):
        names["train"]()
    assert weight.grad is not None


def test_a_runner_under_another_name_is_a_mismatch(gsplat_module):
    with pytest.raises(AdapterMismatchError, match="a class Runner among the names of the"), SkipGate(adapter="gsplat"):
        gsplat_module.cli(print, None)


def test_a_loop_that_goes_on_after_the_configured_end_is_refused_with_a_share():
    """As in a fork that sparsifies after `max_steps`: its steps would have shrunk to zero by then."""
    runner = Runner(DefaultStrategy())
    new_log()
    sentence = "Iterations up to 69 come after a plan that ends with 59"
    with pytest.raises(SkipGSError, match=sentence), SkipGate(runner, refine_share=0.4):
        runner.train(last=69)
    new_log()
    with SkipGate(runner, **RULE) as gate:  # the paper's gate has no plan
        runner.train(last=69)
    assert gate.report()["iterations"] == 70


def test_script_that_spawns_processes_is_refused(gsplat_module):
    gsplat_module.devices = 4
    sentence = "starts 4 processes, which the gate cannot reach"
    with pytest.raises(SkipGSError, match=sentence), SkipGate(adapter="gsplat"):
        script()
    assert not hasattr(torch.multiprocessing.spawn, "__skipgs_plug__")


PPISP = {
    "post_processing": "ppisp",
    "ppisp_use_controller": True,
    "ppisp_controller_distillation": True,
    "ppisp_controller_activation_num_steps": 40,
}


@pytest.mark.parametrize("settings", [{"refine_share": 0.4}, {"compensate": True}, {"share": 0.5}])
def test_iterations_that_train_a_controller_alone_are_not_left_out(settings):
    with pytest.raises(SkipGSError, match="From iteration 40 on this run freezes the Gaussians"):
        SkipGate(HeadRunner(DefaultStrategy(), **PPISP), **settings)
    SkipGate(HeadRunner(DefaultStrategy(), **PPISP)).detach()
    SkipGate(HeadRunner(DefaultStrategy(), **{**PPISP, "ppisp_use_controller": False}), **settings).detach()


def test_the_papers_gate_skips_no_backward_of_the_controller(monkeypatch):
    plain, gated = (HeadRunner(DefaultStrategy(), **PPISP) for _ in range(2))
    stepped = []
    step = torch.optim.Adam.step

    def noted(optimizer, *args, **kwargs):
        if optimizer is gated.controller_optimizer:
            stepped.append(gated.controller.grad is not None)
        return step(optimizer, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", noted)
    new_log()
    plain.train()
    new_log()
    with SkipGate(gated, start_iter=20, policy=SkipAlways()) as gate:
        gated.train()
    assert gate.report()["backwards_skipped"] == 20 and stepped == [True] * 20
    assert gated.controller.item() != plain.controller.item() != 1.0  # the gated one was trained on other Gaussians


@pytest.mark.parametrize("batch_size, patch_size, share", [(1, None, 0.353), (2, None, 0.297), (1, 20, 0.42)])
def test_batches_and_patches_count_towards_the_visits_of_each_view(batch_size, patch_size, share, monkeypatch):
    """Of 1,040 views each is seen once in 520 iterations of two, but in 2,080 iterations of a half."""
    runner = HeadRunner(DefaultStrategy(), batch_size=batch_size, patch_size=patch_size)
    runner.parser.imsize_dict = {1: (40, 20)}
    runner.cfg.max_steps = 3020
    names = runner.parser.image_names
    names += [f"more/{i}.png" for i in range(1040 - len(runner.trainset))]
    runner.trainset.indices += range(6, len(names))
    gate = SkipGate(runner, refine_share="auto")
    original = log.begins

    def begins(iteration, parameters):
        original(iteration, parameters)
        if iteration == 21:
            gate.detach()
            raise KeyboardInterrupt

    new_log()
    monkeypatch.setattr(log, "begins", begins)
    with pytest.raises(KeyboardInterrupt):
        runner.train(last=3019)
    assert gate.report()["refine_share"] == pytest.approx(share, abs=5e-4)


def test_gsplats_other_scripts_are_not_taken_for_it(tmp_path):
    """simple_trainer_2dgs.py has a Runner too, which its own main() builds without gsplat.distributed."""
    script = tmp_path / "simple_trainer_2dgs.py"
    script.write_text("from gsplat.strategy import DefaultStrategy\nclass Runner:\n    pass\ndef main():\n    pass\n")
    with pytest.raises(UnknownTrainerError, match="no function training\\(\\), but Runner, main"):
        find_script_adapter(script)
    script.write_text("from gsplat.distributed import cli\nclass Runner:\n    pass\n")
    assert find_script_adapter(script).name == "gsplat"


def reset_opa():
    """Stand-in of gsplat's function."""


class NeverResets(DefaultStrategy):  # the condition of gsplat 1.5.3
    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        if step % self.reset_every == 0 & step > 0:
            reset_opa()


class ResetsLater(DefaultStrategy):
    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        if step < self.refine_stop_iter:
            if step % self.reset_every == 0 and step > 8:
                reset_opa()
        else:
            self.done = True


class ResetsByFunction(DefaultStrategy):  # its condition calls a function, which is not called to read it
    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        if self.due(step):
            reset_opa()


@pytest.mark.parametrize(
    ("strategy", "resets"),
    [
        (DefaultStrategy, [8, 16]),
        (NeverResets, []),
        (ResetsLater, [16]),
        (ResetsByFunction, [8, 16]),
    ],
)
def test_opacity_resets_are_those_of_the_strategys_own_condition(strategy, resets):
    assert list(iterations_that_run(strategy(), range(60))) == resets
    assert list(strategy_events(strategy()).reset_numbers(range(60))) == resets
