"""An adapter's hooks: a wrong attachment is refused, or the gate is released, and nothing stays replaced."""

from __future__ import annotations

import pytest
import torch
from toy_trainer import Toy, ToyTrainer, attach, plain

from skipgs_plug import AdapterMismatchError, GateOrderError, SkipGate, SkipGSError, UnknownTrainerError
from skipgs_plug.adapters import TrainerInfo


def test_two_attaches_are_refused() -> None:
    trainer = ToyTrainer()
    with attach(trainer):
        with pytest.raises(SkipGSError, match="gated already"):
            attach(trainer)
        with pytest.raises(SkipGSError, match="gated already"):
            attach(ToyTrainer())  # Tensor.backward belongs to one gate at a time
    attach(trainer).detach()
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
