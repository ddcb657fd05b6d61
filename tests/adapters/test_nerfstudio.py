"""nerfstudio: the signal is the main loss, and a loss scaler copes without gradients."""

import sys
import types
import warnings

import pytest
import torch
from cases import RULE, SkipAlways
from lookalikes import nerfstudio
from lookalikes.splats import log, new_log

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError, UnknownTrainerError
from skipgs_plug.adapters.nerfstudio import begins_at_random
from skipgs_plug.adapters.registry import find_script_adapter
from skipgs_plug.core import decision


def train(gate_settings, **options):
    new_log()
    trainer = nerfstudio.Trainer(**options).setup()
    with SkipGate(trainer, **gate_settings) as gate:
        trainer.train()
    return trainer, gate


def test_terms_of_some_iterations_do_not_enter_the_decision():
    _, gate = train(RULE)
    assert max(row.loss for row in gate.trace) < 1.0  # scale_reg, which every tenth iteration adds, is larger
    _, plain = train({**RULE, "enabled": True, "threshold": -0.999})
    assert all(row.loss < 1.0 for row in plain.trace if row.step % 10 == 0)


@pytest.mark.parametrize("max_norm", [None, 1.0])
def test_enabled_scaler_survives_iterations_without_gradients(max_norm):
    _, gate = train({"policy": SkipAlways()}, scaled=True, max_norm=max_norm)
    assert gate.report()["backwards_skipped"] == 40
    assert log.backwards == list(range(20)) and log.steps == list(range(20))


class SkipOdd(SkipAlways):
    def decide(self, view, loss, step):
        return decision.AT_OR_BELOW_MEAN if step % 2 else decision.ABOVE_MEAN


def test_accumulated_gradients_are_stepped_in_a_skipped_iteration():
    train({"policy": SkipOdd()}, accumulate=2)  # it zeroes gradients in even iterations and steps in odd ones
    assert [step for step in log.steps if step >= 20] == list(range(21, 60, 2))


def test_all_iterations_run_while_sizes_on_the_screen_split_gaussians():
    new_log()
    trainer = nerfstudio.Trainer().setup()
    trainer.pipeline.model.strategy.refine_scale2d_stop_iter = 12
    with SkipGate(trainer, share=0.4):
        trainer.train()
    assert set(range(12)) <= set(log.backwards)
    assert len(set(range(12, 20)) & set(log.backwards)) < 8


def test_parameters_are_known_by_the_names_of_their_optimizers():
    new_log()
    trainer = nerfstudio.Trainer().setup()
    rates = {}

    def note(optimizer, *_):
        name = next(name for name, one in trainer.optimizers.optimizers.items() if one is optimizer)
        rates.setdefault(name, []).append(optimizer.param_groups[0]["lr"])

    with SkipGate(trainer, refine_share=0.4, rate_peak=5.0):
        for optimizer in trainer.optimizers.optimizers.values():
            optimizer.register_step_pre_hook(note)
        trainer.train()
    factors = {name: max(found) / 0.02 for name, found in rates.items()}
    assert factors["xyz"] == pytest.approx(10.0 * 0.99**19)  # its own schedule goes on
    assert factors["scaling"] == pytest.approx(10.0)
    assert factors["opacity"] == pytest.approx(1.0)


def test_trainer_before_setup_is_refused():
    with pytest.raises(AdapterMismatchError, match=r"whose setup\(\) was called, as in nerfstudio-project/nerfstudio"):
        SkipGate(nerfstudio.Trainer())


def test_several_processes_without_a_group_are_refused():
    with pytest.raises(SkipGSError, match="4 processes train together"):
        SkipGate(nerfstudio.Trainer(world_size=4).setup())


def test_script_is_reached_through_the_trainer_class(monkeypatch):
    module = types.ModuleType("nerfstudio.engine.trainer")
    module.Trainer = type("Trainer", (nerfstudio.Trainer,), {})
    monkeypatch.setitem(sys.modules, "nerfstudio.engine.trainer", module)
    new_log()
    with SkipGate(adapter="nerfstudio", **RULE) as gate:
        module.Trainer().setup().train()
    gate.verify()
    assert gate.report()["iterations"] == 60 and gate.report()["backwards_skipped"] > 0
    assert torch.Tensor.backward.__module__ == "torch._tensor"


class OldModel(nerfstudio.Model):
    """Densifies by itself, as splatfacto before 1.1.5 and methods of others do."""

    until = 20

    def __init__(self):
        super().__init__(None)

    def after_train(self, step):
        self.step = step
        if self.step >= self.until:
            return
        self.norms = self.info["means2d"].grad.norm()

    def refinement_after(self, step):
        if step < self.until and step % 5 == 0:
            self.split_gaussians()

    def split_gaussians(self):
        """Stand for a change of the model."""


def of_model(model, *callbacks):
    trainer = nerfstudio.Trainer().setup()
    trainer.pipeline.model, trainer.callbacks, trainer.schedulers = model, [*callbacks], []
    trainer.optimizers.optimizers = {name: torch.optim.Adam([value]) for name, value in model.values.items()}
    return trainer


def of_old_model(model):
    return of_model(model, model.after_train, model.refinement_after)


@pytest.mark.filterwarnings("ignore:The trainer does more than .*split_gaussians")
def test_a_model_that_densifies_by_itself_is_gated_when_it_reads_no_gradients_any_more():
    new_log()
    trainer = of_old_model(OldModel())
    with SkipGate(trainer, policy=SkipAlways()) as gate:
        trainer.train()
    assert log.backwards == list(range(20)) and gate.report()["settings"]["start_iter"] == 20
    with pytest.raises(SkipGSError, match="start_iter=15 is too early"):
        SkipGate(of_old_model(OldModel()), start_iter=15)


def test_a_model_that_reads_gradients_until_the_end_is_refused():
    model = OldModel()
    model.until = 60
    with pytest.raises(AdapterMismatchError, match=r"reads gradients .* until its end"):
        SkipGate(of_old_model(model), start_iter=40)


def test_a_model_without_densification_needs_a_start():
    with pytest.raises(SkipGSError, match="It is not known when this trainer's densification ends"):
        SkipGate(of_model(nerfstudio.Model(None)))


def test_a_trainer_that_overrides_the_loop_is_gated_and_one_of_another_class_is_refused(monkeypatch):
    module = types.ModuleType("nerfstudio.engine.trainer")
    module.Trainer = type("Trainer", (nerfstudio.Trainer,), {})
    monkeypatch.setitem(sys.modules, "nerfstudio.engine.trainer", module)
    own = type("Own", (module.Trainer,), {"train": nerfstudio.Trainer.train})  # calls no train() of its parent
    new_log()
    with SkipGate(adapter="nerfstudio", **RULE) as gate:
        own().setup().train()
    gate.verify()
    assert gate.report()["backwards_skipped"] > 0
    with (
        pytest.raises(AdapterMismatchError, match=r"it trains without a call of Trainer.train\(\)"),
        SkipGate(adapter="nerfstudio", **RULE),
    ):
        nerfstudio.Trainer().setup().train()


OWN_LOOP = """
import torch
from nerfstudio.cameras.cameras import Cameras

def fit():
    for step in range(60):
        torch.ones(1, requires_grad=True).sum().backward()
"""


def test_a_script_that_only_reads_scenes_with_nerfstudio_is_not_recognised(tmp_path):
    script = tmp_path / "train.py"
    script.write_text(OWN_LOOP)
    with pytest.raises(UnknownTrainerError, match="calls backward in fit"):
        find_script_adapter(script)
    script.write_text("from nerfstudio.scripts.train import entrypoint\nentrypoint()\n")
    assert find_script_adapter(script).name == "nerfstudio"


@pytest.mark.parametrize("enabled", [True, False])
def test_training_by_another_function_is_warned_of_once(enabled, recwarn):
    def fit():
        torch.ones(1, requires_grad=True).sum().backward()

    with SkipGate(adapter="nerfstudio", enabled=enabled, start_iter=5):
        for _ in range(30):
            fit()
    said = [str(one.message) for one in recwarn]
    assert len(said) == enabled
    assert all("fit() called backward, and no module nerfstudio.engine.trainer was seen" in one for one in said)


class Called(types.SimpleNamespace):
    """A callback of nerfstudio: it calls its function by an interval, or in a list of iterations."""

    def __call__(self, step):
        every = getattr(self, "update_every_num_iters", None)
        if step % every == 0 if every else step in self.iters:
            self.func(step)


def test_iterations_that_callbacks_name_always_run():
    new_log()
    model, calls = nerfstudio.Model(nerfstudio.DefaultStrategy()), []

    def noted(step):
        calls.append(step)

    trainer = of_model(
        model,
        model.step_post_backward,
        Called(func=noted, update_every_num_iters=11),
        Called(func=noted, iters=(37, 52)),
    )
    with SkipGate(trainer, refine_share=0.2) as gate:
        trainer.train()
    assert calls == [0, 11, 22, 33, 37, 44, 52, 55] and gate.report()["iterations_skipped"] > 0


class Editing(nerfstudio.Pipeline):
    """Edits its images in some iterations, as Instruct-GS2GS does."""

    def get_train_loss_dict(self, step):
        if (step - 1) % 7 == 0 and step > 1:
            self.edited = step
        return super().get_train_loss_dict(step)


def test_conditions_of_a_pipeline_are_warned_of():
    def trainer():
        made = nerfstudio.Trainer().setup()
        made.pipeline.__class__ = Editing
        return made

    sentence = r"Editing\.get_train_loss_dict\(\) has a condition on .* not read \(\(step - 1\) % 7 == 0\)"
    with pytest.warns(RuntimeWarning, match=sentence) as said:
        SkipGate(trainer(), refine_share=0.4).detach()
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SkipGate(trainer(), refine_share=0.4, always=[7]).detach()
        SkipGate(trainer(), **RULE).detach()


@pytest.mark.parametrize(
    "model, random",
    [
        (types.SimpleNamespace(), None),
        (types.SimpleNamespace(config=types.SimpleNamespace(random_init=False), seed_points=(1, 2)), False),
        (types.SimpleNamespace(config=types.SimpleNamespace(random_init=True), seed_points=(1, 2)), True),
        (types.SimpleNamespace(config=types.SimpleNamespace(random_init=False), seed_points=None), True),
    ],
)
def test_a_model_tells_of_random_points(model, random):
    assert begins_at_random(model) is random
