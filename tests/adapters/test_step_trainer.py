"""The pip package: inclusive bounds, the reset right before the gate begins, wrappers added later."""

import os
import sys
import types

import pytest
from cases import RULE
from lookalikes import step_trainer
from lookalikes.splats import log, new_log

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError
from skipgs_plug.core.pace import densification_events, needs


def test_start_follows_the_latest_inclusive_bound_and_the_reset_in_it_pauses():
    new_log()
    trainer = step_trainer.make()
    with SkipGate(trainer, **RULE) as gate:
        step_trainer.training(trainer, step_trainer.dataset(), 60)
    assert gate.config.start_iter == 21
    assert log.structure[-1][:2] == (20, "reset")
    assert [row.reason for row in gate.trace[:4]] == ["pause"] * 4 and gate.trace[4].reason != "pause"
    assert trainer.raised == 6  # each iteration computes the loss once, which raises the SH degree


def test_wrappers_put_around_a_gated_trainer_stay_gated():
    new_log()
    trainer = step_trainer.make()
    with SkipGate(trainer, **RULE) as gate:
        step_trainer.training(step_trainer.SHLifter(trainer), step_trainer.dataset(), 60)
    gate.verify()
    assert gate.report()["iterations"] == 60 and gate.report()["backwards_skipped"] > 0


def test_trainer_without_densification_asks_for_a_start():
    trainer = step_trainer.make()
    del trainer.base_trainer.base_trainer.densifier.prune_until_iter
    del trainer.base_trainer.base_trainer.densifier.base_densifier
    del trainer.base_trainer.opacity_reset_until_iter
    with pytest.raises(
        SkipGSError,
        match="not known when this trainer's densification ends, or that it densifies at all; give start_iter=",
    ):
        SkipGate(trainer)
    SkipGate(trainer, start_iter=5).detach()


def test_early_start_is_refused():
    with pytest.raises(SkipGSError, match="start_iter=20 is too early: up to iteration 21"):
        SkipGate(step_trainer.make(), start_iter=20)


def test_renamed_method_names_what_was_expected_and_where():
    trainer = step_trainer.make()
    with pytest.raises(AdapterMismatchError, match=r"with before_optim_hook, as in gaussian-splatting 2\.11\.0"):
        SkipGate(
            types.SimpleNamespace(**{n: getattr(trainer, n) for n in dir(trainer) if n != "before_optim_hook"}),
            adapter="step_trainer",
        )


def test_script_is_reached_through_prepare_trainer(monkeypatch):
    prepare = types.ModuleType("gaussian_splatting.prepare")
    prepare.prepare_trainer = lambda *args, **kwargs: step_trainer.make()
    monkeypatch.setitem(sys.modules, "gaussian_splatting", types.ModuleType("gaussian_splatting"))
    monkeypatch.setitem(sys.modules, "gaussian_splatting.prepare", prepare)
    new_log()
    main = {"prepare": prepare, "args": types.SimpleNamespace(destination="out")}
    with SkipGate(adapter="step_trainer", **RULE) as gate:
        exec("trainer = prepare.prepare_trainer()", main)
        step_trainer.training(main["trainer"], step_trainer.dataset(), 60)
    gate.verify()
    assert gate.report()["iterations"] == 60 and gate.report()["backwards_skipped"] > 0
    assert gate.adapter.output_folder == os.path.abspath("out")
    assert not hasattr(prepare.prepare_trainer, "__skipgs_plug__")


def test_a_script_tells_the_training_views(monkeypatch):
    prepare = types.ModuleType("gaussian_splatting.prepare")
    prepare.prepare_trainer = lambda gaussians, dataset, mode: step_trainer.make()
    monkeypatch.setitem(sys.modules, "gaussian_splatting", types.ModuleType("gaussian_splatting"))
    monkeypatch.setitem(sys.modules, "gaussian_splatting.prepare", prepare)
    new_log()
    cameras = [step_trainer.Camera(camera.image_name, camera) for camera in step_trainer.dataset()]
    with SkipGate(adapter="step_trainer", **RULE) as gate:
        main = {"prepare": prepare, "dataset": cameras}
        exec("trainer = prepare.prepare_trainer(gaussians=None, dataset=dataset, mode='densify')", main)
        step_trainer.training(main["trainer"], step_trainer.dataset(), 60)
    assert not gate.released and gate.report()["backwards_skipped"] > 0
    assert gate._engine._view_names == [camera.ground_truth_image_path for camera in cameras]


def trained_with_share(trainer):
    """Train with a share of 0.4, and return its report and the densification events that ran."""
    new_log()
    with SkipGate(trainer, share=0.4) as gate:
        for step in gate.iterations(range(1, 61)):
            trainer.step(step_trainer.pick_camera(step_trainer.dataset(), step))
    return gate.report(), sorted(log.behind)


def test_a_share_leaves_out_events_of_densifiers_and_pruners_but_no_reset(monkeypatch):
    monkeypatch.setattr(densification_events, "LEAST_EVENTS", 1)  # leave out some of a few events
    monkeypatch.setattr(needs, "STEPS_PER_EVENT", 1)
    trainer = step_trainer.make()
    report, events = trained_with_share(trainer)
    growing = report["growing"]
    # All events: 6, 9, 12, 15 of the densifier; 5, 10, 15, 20 of the pruner.
    assert growing["events_run"] + growing["events_skipped"] == 7 and growing["events_skipped"] > 0
    assert set(events) < {6, 9, 12, 15} and growing["iterations_skipped"] > 0
    assert [step for step, kind, _ in log.structure if kind == "reset"] == [10, 20]
    assert trainer.raised == 6 and trainer.curr_step == 60


def test_all_iterations_of_a_short_schedule_run_while_sizes_on_the_screen_prune():
    trainer = step_trainer.make()
    trainer.base_trainer.base_trainer.densifier.prune_screensize_threshold = 20
    report, events = trained_with_share(trainer)
    assert events == [6, 9, 12, 15] and report["growing"]["iterations_skipped"] == 0
    assert report["iterations_skipped"] > 0


@pytest.mark.parametrize("unread", ["bound", "wrapper"])
@pytest.mark.filterwarnings("ignore:The trainer does more than", "ignore:It is not known which iterations need")
def test_all_iterations_of_densification_run_if_not_all_events_are_known(unread):
    trainer = step_trainer.make()
    if unread == "bound":
        trainer.relocate_until_iter = 18
    with pytest.warns(RuntimeWarning, match="The densification events of iterations 1 to 20 are not known"):
        report, events = trained_with_share(trainer if unread == "bound" else Trimmer(trainer))
    assert events == [6, 9, 12, 15] and report["growing"] is None
    assert report["iterations_skipped"] > 0


class Trimmer(step_trainer.TrainerWrapper):
    """Prunes later than the trainer's bounds, where the adapter does not look."""

    def after_optim_hook(self, loss, out, camera):
        if self.curr_step == 40:
            self.model.prune_gaussians(0.2, self.model.values["opacity"])


def test_a_later_prune_of_a_users_wrapper_pauses_the_gate():
    new_log()
    trainer = Trimmer(step_trainer.make())
    with SkipGate(trainer, **RULE) as gate:
        step_trainer.training(trainer, step_trainer.dataset(), 60)
    assert gate.config.start_iter == 21 and len(log.values[41][0]) < len(log.values[40][0])
    assert [row.reason for row in gate.trace if row.step in range(41, 45)] == ["pause"] * 4
    assert gate.report()["events"]["number of Gaussians"] == 1


@pytest.mark.parametrize("settings", [{"refine_share": 0.4}, {"refine_share": 0.4, "always": [40]}, RULE])
def test_iterations_that_a_users_wrapper_needs_are_named_as_unknown(settings, recwarn):
    with SkipGate(Trimmer(step_trainer.make()), **settings):
        pass
    said = [str(one.message) for one in recwarn if "curr_step" in str(one.message)]
    if settings == {"refine_share": 0.4}:
        assert len(said) == 1 and "which iterations need Trimmer.after_optim_hook():" in said[0]
    else:
        assert not said


def test_layers_of_the_package_itself_need_no_warning(recwarn):
    with SkipGate(step_trainer.make(), refine_share=0.4):
        pass
    assert not [one for one in recwarn if "curr_step" in str(one.message)]
