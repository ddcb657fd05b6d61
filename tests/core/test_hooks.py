"""An adapter's hooks, on a trainer of twenty lines: mis-attachment is loud, detach leaves nothing."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from always import Always
from torch.optim import lr_scheduler as schedulers

from skipgs_plug import AdapterMismatchError, GateOrderError, SkipGate, SkipGSError, UnknownTrainerError
from skipgs_plug.adapters import AbstractAdapter, TrainerInfo
from skipgs_plug.core.pace.refining import Refining
from skipgs_plug.core.policy import SkipPolicy


class ToyTrainer:
    """Ten views, densification until iteration 20, a prune at 60."""

    def __init__(self, steps: int = 100, backwards: int = 1, render: bool = True) -> None:
        self.parameter = torch.nn.Parameter(torch.ones(3))
        self.optimizer = torch.optim.Adam([self.parameter], lr=0.05)
        self.steps, self.backwards, self.rendering = steps, backwards, render
        self.noise = 0

    def begin(self, step: int) -> None: ...

    def render(self, view: str) -> torch.Tensor:
        return self.parameter * (1.0 + 0.1 * int(view[1:]))

    def measure(self, step: int) -> None: ...

    def prune(self) -> None: ...

    def add_noise(self) -> None:
        self.noise += 1

    def train(self) -> None:
        for step in range(self.steps):
            self.begin(step)
            image = self.render(f"v{step % 10}") if self.rendering else self.parameter
            loss = (image**2).mean()
            self.measure(step)
            for _ in range(self.backwards):
                loss.backward(retain_graph=True)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            self.add_noise()
            if step == 60:
                self.prune()


class ScaledTrainer(ToyTrainer):
    """Scales its loss, as mixed precision needs it."""

    def train(self) -> None:
        scaler = torch.amp.GradScaler("cpu")
        for step in range(self.steps):
            self.begin(step)
            scaler.scale((self.render(f"v{step % 10}") ** 2).mean()).backward()
            scaler.unscale_(self.optimizer)
            scaler.step(self.optimizer)
            scaler.update()
            self.optimizer.zero_grad(set_to_none=True)


class Toy(AbstractAdapter):
    name = "toy"
    checked = "ToyTrainer 1.0"
    hurried = False

    @classmethod
    def matches(cls, trainer) -> bool:
        return isinstance(trainer, ToyTrainer)

    def attach(self, hooks) -> None:
        trainer = self.trainer
        hooks.before(trainer, "begin", hooks.iteration)
        hooks.before(trainer, "render", hooks.view)
        hooks.events(trainer, "prune")
        hooks.suppress_on_skip(trainer, "add_noise")
        hooks.gate_tensor_backward("train")
        if not self.hurried:
            hooks.ready(
                TrainerInfo(20, view_names=[f"v{i}" for i in range(10)], defaults={"warmup": 12, "pause_iters": 15})
            )

    def must_run(self, step: int) -> bool:
        return step == 45

    def optimizers(self):
        return [self.trainer.optimizer]


def attach(trainer: ToyTrainer, **settings) -> SkipGate:
    return SkipGate(trainer, adapter=Toy(trainer), **settings)


def plain(trainer: ToyTrainer) -> bool:
    return not {"begin", "render", "prune", "add_noise"} & set(vars(trainer)) and not hasattr(
        torch.Tensor.backward, "__skipgs_plug__"
    )


def test_gates_counts_and_leaves_nothing_behind() -> None:
    trainer = ToyTrainer()
    with attach(trainer) as gate:
        assert len(gate.patched) == 9
        trainer.train()
        gate.verify()
    assert plain(trainer)
    assert gate.patched == []
    stats = gate.stats()
    assert (stats["iterations"], stats["gated_iterations"]) == (100, 80)
    assert stats["reasons"]["warm-up"] == 12
    assert stats["reasons"]["forced"] == 1
    assert stats["paused"] == 15
    assert stats["events"] == {"prune": 1}
    assert stats["backwards_skipped"] > 0
    assert trainer.noise == 100 - stats["backwards_skipped"]
    assert gate.config.start_iter == 20
    assert 0 < stats["t_post"] < stats["t_total"]


def test_what_the_user_gave_stands() -> None:
    trainer = ToyTrainer()
    with attach(trainer, start_iter=50, warmup=3) as gate:
        assert (gate.config.start_iter, gate.config.warmup, gate.config.pause_iters) == (50, 3, 15)


@pytest.mark.parametrize("settings", [{"enabled": False}, {"warmup": 1000}])
def test_never_skipping_changes_no_bit(settings) -> None:
    expected, trainer = ToyTrainer(), ToyTrainer()
    expected.train()
    with attach(trainer, **settings):
        trainer.train()
    assert torch.equal(expected.parameter, trainer.parameter)
    assert trainer.noise == 100


def test_a_loss_scaler_survives_iterations_without_gradients() -> None:
    trainer, never = ScaledTrainer(), ScaledTrainer()
    with attach(trainer, policy=Always()) as gate:
        trainer.train()
    assert gate.released is None and gate.stats()["backwards_skipped"] == 79
    assert trainer.optimizer.state[trainer.parameter]["step"] == 21
    assert gate.patched == []
    with attach(never, warmup=100):
        never.train()
    plain_one = ScaledTrainer()
    plain_one.train()
    assert torch.equal(never.parameter, plain_one.parameter)


def test_always_skipping_keeps_parameters_but_for_forced_iterations() -> None:
    policy = Always()
    trainer = ToyTrainer(45)
    with attach(trainer, policy=policy):
        trainer.train()
    expected = ToyTrainer(20)
    expected.train()
    assert torch.equal(expected.parameter, trainer.parameter)
    assert policy.asked == list(range(20, 45))


def test_a_signal_is_decided_on_in_its_own_iteration_only() -> None:
    class Signalling(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.before(self.trainer, "measure", lambda step: hooks.signal(123.0) if step == 30 else None)

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Signalling(trainer), record_trace=True) as gate:
        trainer.train()
    assert [row.step for row in gate.trace if row.loss == 123.0] == [30]


def test_other_things_are_taken_back_too() -> None:
    undone = []

    class Listing(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.on_detach("trainer.registry", lambda: undone.append(1))

    trainer = ToyTrainer()
    gate = SkipGate(trainer, adapter=Listing(trainer))
    assert "trainer.registry" in gate.patched
    gate.detach()
    gate.detach()
    assert undone == [1]


def test_two_attaches_are_refused() -> None:
    trainer = ToyTrainer()
    with attach(trainer):
        with pytest.raises(SkipGSError, match="gated already"):
            attach(trainer)
        with pytest.raises(SkipGSError, match="gated already"):
            attach(ToyTrainer())  # Tensor.backward belongs to one gate at a time
    attach(trainer).detach()
    assert plain(trainer)


def test_detaches_on_an_exception_in_training() -> None:
    trainer = ToyTrainer()
    trainer.add_noise = lambda: 1 / 0  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError), attach(trainer):
        trainer.train()
    del trainer.add_noise
    assert plain(trainer)


@pytest.mark.parametrize("backwards", [0, 2])
def test_any_other_number_of_backwards_releases_the_gate_after_ten_iterations(backwards: int) -> None:
    trainer = ToyTrainer(backwards=backwards)
    gate = attach(trainer)
    with pytest.warns(RuntimeWarning, match=f"{10 * backwards} training backwards were seen in 10 .*ToyTrainer 1.0"):
        trainer.train()
    assert plain(trainer) and "in 10 iterations" in gate.released


def test_short_runs_are_judged_by_verify() -> None:
    trainer = ToyTrainer(steps=3, backwards=0)
    with attach(trainer) as gate:
        with pytest.raises(AdapterMismatchError, match="no iteration"):
            gate.verify()
        trainer.train()
        with pytest.raises(AdapterMismatchError, match="0 training backwards were seen in 3 iterations"):
            gate.verify()


def test_backward_without_a_render_is_an_error_at_once() -> None:
    trainer = ToyTrainer(render=False)
    gate = attach(trainer)
    with pytest.raises(AdapterMismatchError, match="no training view was rendered"):
        trainer.train()
    assert gate.patched == []
    assert plain(trainer)


def test_iterating_before_ready_is_an_error() -> None:
    class Hurried(Toy):
        hurried = True

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Hurried(trainer)), pytest.raises(AdapterMismatchError, match="densification"):
        trainer.train()


def test_backwards_outside_iterations_release_the_gate() -> None:
    class Deaf(Toy):
        def attach(self, hooks) -> None:
            hooks.gate_tensor_backward("train")
            hooks.ready(TrainerInfo(20))

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Deaf(trainer)), pytest.warns(RuntimeWarning, match="in no iteration"):
        trainer.train()


def test_half_an_attachment_is_taken_back() -> None:
    trainer = ToyTrainer()
    with pytest.raises(SkipGSError, match="start_iter"):
        SkipGate(trainer, adapter=Endless(trainer))
    assert plain(trainer)


class Endless(Toy):
    """A trainer that does not densify."""

    hurried = True

    def attach(self, hooks) -> None:
        super().attach(hooks)
        hooks.ready(TrainerInfo(None))


def test_facts_that_come_late_and_are_refused_leave_nothing_behind() -> None:
    class Late(Toy):
        hurried = True

        def attach(self, hooks) -> None:
            hooks.before(self.trainer, "begin", lambda step: hooks.ready(TrainerInfo(None)))
            hooks.gate_tensor_backward("train")

    trainer = ToyTrainer()
    gate = SkipGate(trainer, adapter=Late(trainer))
    with pytest.raises(SkipGSError, match="start_iter"):
        trainer.train()
    assert gate.patched == []
    assert plain(trainer)


def test_two_views_of_one_name_are_refused() -> None:
    class Twins(Toy):
        hurried = True

        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.ready(TrainerInfo(20, view_names=["a", "a"]))

    trainer = ToyTrainer()
    with pytest.raises(SkipGSError, match="'a' names 2"):
        SkipGate(trainer, adapter=Twins(trainer))
    assert plain(trainer)


def test_state_of_another_scene_is_refused() -> None:
    other = SkipGate(start_iter=0)
    other.backward(torch.tensor(1.0, requires_grad=True), view="elsewhere", step=0)
    with attach(ToyTrainer()) as gate, pytest.raises(SkipGSError, match=r"another scene.*'elsewhere'"):
        gate.load_state_dict(other.state_dict())


def test_verbs_belong_to_loops_of_ones_own() -> None:
    with attach(ToyTrainer()) as gate, pytest.raises(GateOrderError, match="adapter 'toy'"):
        gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)


def test_a_trainer_may_count_with_numpy() -> None:
    class Counted(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.iteration(np.int64(7))

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Counted(trainer)) as gate:
        assert json.loads(json.dumps(gate.state_dict()))["step"] == 7


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


def test_what_the_adapter_knows_of_numbers_holds_beside_what_the_user_chose() -> None:
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


def test_processes_without_a_group_are_refused(monkeypatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    trainer = ToyTrainer()
    with pytest.raises(SkipGSError, match="2 processes train together"):
        attach(trainer)
    assert plain(trainer)
    gate = SkipGate(start_iter=0)
    with pytest.raises(SkipGSError, match="init_process_group"):
        gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)


def test_a_trainer_that_knows_of_more_processes_is_believed() -> None:
    class Crowd(Toy):
        hurried = True

        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.ready(TrainerInfo(20, world_size=4))

    with pytest.raises(SkipGSError, match="4 processes"):
        SkipGate(trainer := ToyTrainer(), adapter=Crowd(trainer))


def test_unknown_trainers_get_the_list_and_the_manual_form() -> None:
    with pytest.raises(UnknownTrainerError, match=r"reference.*SkipGate\(start_iter="):
        SkipGate(object())
    with pytest.raises(UnknownTrainerError, match="no adapter 'fastestgs'"):
        SkipGate(object(), adapter="fastestgs")


def test_a_training_under_way_is_not_lost_when_the_gate_fails(monkeypatch) -> None:
    """An error of the gate's own code releases it: the rest of the run trains as without a gate."""

    def fails(self, view, loss, step):
        if step == 50:
            raise ZeroDivisionError("of the policy")
        return original(self, view, loss, step)

    original = SkipPolicy.decide
    monkeypatch.setattr(SkipPolicy, "decide", fails)
    trainer = ToyTrainer()
    gate = attach(trainer)
    with pytest.warns(RuntimeWarning, match=r"released in iteration 50, .*ZeroDivisionError: of the policy"):
        trainer.train()
    assert plain(trainer) and gate.patched == []
    assert gate.stats()["gated_iterations"] < 50


def test_an_error_of_the_trainers_own_backward_stays_its_own() -> None:
    trainer = ToyTrainer()
    with attach(trainer) as gate:
        with pytest.raises(MemoryError):
            gate._hooks.iteration(0)  # type: ignore[union-attr]
            gate._hooks.backward(torch.ones((), requires_grad=True), lambda: (_ for _ in ()).throw(MemoryError()), "v0")  # type: ignore[union-attr]
        assert gate.patched


def test_a_loop_goes_on_in_all_its_iterations_when_a_phase_fails(monkeypatch) -> None:
    def fails(self, number):
        raise ZeroDivisionError("of the phase")

    monkeypatch.setattr(Refining, "runs", fails)
    gate = SkipGate(start_iter=40, refine_share=0.25)
    with pytest.warns(RuntimeWarning, match="released in iteration 40, .* of the phase"):
        assert list(gate.iterations(range(60), always=())) == list(range(60))
