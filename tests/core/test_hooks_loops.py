"""An adapter's hooks: loops that leave out iterations, their schedulers, and second trainings."""

from __future__ import annotations

import pytest
import torch
from torch.optim import lr_scheduler as schedulers
from toy_trainer import Toy, ToyTrainer, attach

from skipgs_plug import GateOrderError, SkipGate
from skipgs_plug.core.pace.refining import Refining


def test_training_anew_with_one_gate_is_refused() -> None:
    trainer = ToyTrainer()
    with attach(trainer):
        trainer.train()
        with pytest.raises(GateOrderError, match="went back from 99 to 0"):
            trainer.train()


def test_a_gate_that_is_off_ends_no_second_training() -> None:
    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Toy(trainer), enabled=False):
        trainer.train()
        with pytest.warns(RuntimeWarning, match="went back from 99 to 0, as in a second training run"):
            trainer.train()
    assert trainer.noise == 200


def test_a_second_training_in_a_script_releases_the_gate() -> None:
    trainer = ToyTrainer()

    class InScript(Toy):
        def attach_script(self, hooks) -> None:
            self.trainer = trainer
            self.attach(hooks)

    with SkipGate(adapter=InScript()) as gate:
        trainer.train()
        sentence = r"The gate is released in iteration 0, .* \(iterations went back from 99 to 0"
        with pytest.warns(RuntimeWarning, match=sentence):
            trainer.train()
    assert trainer.noise == 200 - gate.stats()["backwards_skipped"]  # the second training was not gated


def test_iterations_that_the_adapter_names_run_beside_those_that_the_user_names() -> None:
    class Knowing(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.always(lambda numbers: (n for n in numbers if n % 30 == 29))

    trainer, ran = ToyTrainer(), []

    def train(steps) -> None:
        for step in steps:
            trainer.begin(step)
            ran.append(step)
            (trainer.render("v0") ** 2).mean().backward()

    with SkipGate(trainer, adapter=Knowing(trainer), refine_share=0.1) as gate:
        train(gate.iterations(range(100), always=[70]))
    assert ran == [*range(28), 29, 59, 70, 89, 99]


def test_where_the_trainer_has_a_loop_of_its_own_no_other_optimizer_takes_larger_steps() -> None:
    class Numbered(ToyTrainer):
        def numbers(self) -> range:
            return range(self.steps)

    class OwnLoop(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.own_loop(self.trainer, "numbers")

    trainer, own, others = Numbered(), [], []
    pose = torch.nn.Parameter(torch.zeros(1))
    pose.grad = torch.ones(1)
    of_the_pose = torch.optim.SGD([pose], lr=0.5)

    def train() -> None:
        for step in trainer.numbers():
            trainer.begin(step)
            (trainer.render("v0") ** 2).mean().backward()
            steps = (trainer.optimizer, trainer.parameter, own), (of_the_pose, pose, others)
            for optimizer, parameter, moved in steps:
                before = parameter.detach().clone()
                optimizer.step()
                moved.append(float((parameter.detach() - before).abs().max()))

    with SkipGate(trainer, adapter=OwnLoop(trainer), refine_share=0.5) as gate:
        train()
    assert gate.stats()["iterations_skipped"] == len(range(100)) - len(own) == 39
    assert max(own[:20]) < 0.06 and max(own) > 0.1  # the rate is 0.05, and Adam's steps are about as long
    assert set(others) == {0.5}


SCHEDULERS = {
    "one": lambda optimizer: schedulers.ExponentialLR(optimizer, 0.99),
    "chained": lambda optimizer: schedulers.ChainedScheduler(
        [schedulers.LinearLR(optimizer, 0.1, total_iters=40), schedulers.ExponentialLR(optimizer, 0.99)]
    ),
    "one after the other": lambda optimizer: schedulers.SequentialLR(
        optimizer,
        [schedulers.LinearLR(optimizer, 0.1, total_iters=40), schedulers.ExponentialLR(optimizer, 0.99)],
        milestones=[40],
    ),
    "with restarts": lambda optimizer: schedulers.CosineAnnealingWarmRestarts(optimizer, 30),
}


def train(trainer, every, twentieth, first: int = 0, stop: int | None = None) -> None:
    """Train with schedulers that step in every iteration, and with one that steps in every twentieth."""
    for step in range(first, 100):
        trainer.begin(step)
        (trainer.render("v0") ** 2).mean().backward()
        trainer.optimizer.step()
        [scheduler.step() for scheduler in every]
        if step % 20 == 0:
            twentieth.step()
        if step == stop:
            return


class Scheduling(Toy):
    def attach(self, hooks) -> None:
        super().attach(hooks)
        hooks.loop(globals(), "train")


@pytest.mark.filterwarnings("ignore:The epoch parameter")  # SequentialLR of torch 2.4 passes one itself
@pytest.mark.parametrize("stop", [None, 50], ids=["whole", "resumed"])
@pytest.mark.parametrize("kind", SCHEDULERS)
def test_schedulers_that_count_calls_are_where_they_would_be_if_all_iterations_ran(kind, stop) -> None:
    rates = []
    for settings in ({"enabled": False}, {"refine_share": 0.1}):
        trainer = ToyTrainer()
        every = [SCHEDULERS[kind](trainer.optimizer)]
        twentieth = schedulers.ExponentialLR(trainer.optimizer, 0.9)
        with SkipGate(trainer, adapter=Scheduling(trainer), **settings) as gate:
            train(trainer, every, twentieth, stop=stop)
        state = gate.state_dict()
        if stop is not None:
            with SkipGate(trainer, adapter=Scheduling(trainer), **settings) as resumed:
                resumed.load_state_dict(state)
                train(trainer, every, twentieth, first=stop + 1)
        every[0].step()  # once more, after training
        rates.append(trainer.optimizer.param_groups[0]["lr"])
    assert rates[1] == pytest.approx(rates[0])
    assert gate.stats()["iterations_skipped"] > 20


def test_a_loop_goes_on_in_all_its_iterations_when_a_phase_fails(monkeypatch) -> None:
    def fails(self, number):
        raise ZeroDivisionError("of the phase")

    monkeypatch.setattr(Refining, "runs", fails)
    gate = SkipGate(start_iter=40, refine_share=0.25)
    with pytest.warns(RuntimeWarning, match="released in iteration 40, .* of the phase"):
        assert list(gate.iterations(range(60), always=())) == list(range(60))
