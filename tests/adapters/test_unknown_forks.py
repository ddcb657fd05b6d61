"""Forks that no adapter knows: refused, warned of, or let go on ungated, by what their loop does."""

import types

import pytest
import torch
from cases import SkipAlways
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, new_log, photo_loss, pick

from skipgs_plug import AdapterMismatchError, SkipGate

TRAIN = """
def training(dataset, opt, pipe):
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    for iteration in range(1, opt.iterations + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        loss = photo_loss(render(viewpoint_cam, gaussians{argument})["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.{until}:
                pass  # densification
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            {extra}
"""


class GaussianModel(SplatModel):
    def shake(self):
        self.values["xyz"].add_(0.01)

    def count(self):
        self.counted = True


def render(camera, gaussians, kernel_size=0.3):
    return draw(camera, gaussians.values)


def stranger(argument="", extra="pass", until="densify_until_iter"):
    module = types.ModuleType("train")
    own = {"GaussianModel": type("GaussianModel", (GaussianModel,), {}), "render": render, "Scene": Scene}
    module.__dict__.update(own, log=log, pick=pick, photo_loss=photo_loss, torch=torch)
    exec(TRAIN.format(argument=argument, extra=extra, until=until), vars(module))
    return module


def train(module):
    new_log()
    module.training(dataset(), types.SimpleNamespace(iterations=40, densify_until_iter=20), None)


def test_loop_of_inrias_own_is_no_stranger():
    with SkipGate(stranger(), policy=SkipAlways()) as gate:
        assert gate.adapter.name == "inria"
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


@pytest.mark.parametrize(
    ("extra", "sentence"),
    [
        ("torch.randn_like(gaussians.values['xyz'])", r"changes values itself \(randn_like\)"),
        ("gaussians.values['xyz'].add_(0.1)", r"changes values itself \(add_\)"),
        ("[v.mul_(0.9) for v in gaussians.values.values()]", r"changes values itself \(mul_\)"),
    ],
)
def test_loop_that_changes_values_itself_is_refused(extra, sentence):
    with pytest.raises(AdapterMismatchError, match=sentence):
        SkipGate(stranger(extra=extra))
    assert torch.Tensor.backward.__module__ == "torch._tensor"


def test_loop_without_an_end_of_densification_is_refused():
    with pytest.raises(AdapterMismatchError, match="its loop never asks for densify_until_iter"):
        SkipGate(stranger(until="iterations"))


def test_further_calls_and_arguments_are_listed():
    with pytest.warns(RuntimeWarning, match="that no adapter knows") as warnings:
        gate = SkipGate(stranger(", kernel_size=0.1", "gaussians.count()"), policy=SkipAlways())
    sentence = str(warnings[0].message)
    assert "Recognised: render, backward, training_setup, update_learning_rate." in sentence
    assert sentence.endswith("left to go on in skipped iterations: render(kernel_size=), count().")
    with gate:
        train(gate.adapter.trainer)  # nothing moves, so it is gated to the end
    assert gate.report()["backwards_skipped"] == 21


def test_what_moves_the_model_in_skipped_iterations_ends_the_gate_and_not_the_training():
    with pytest.warns(RuntimeWarning, match=r"shake\(\)"):
        gate = SkipGate(stranger(extra="gaussians.shake()"), policy=SkipAlways())
    with gate, pytest.warns(RuntimeWarning, match="The loop moved xyz in iteration 21, whose backward was skipped"):
        train(gate.adapter.trainer)
        assert not gate.patched
    assert gate.report()["backwards_skipped"] == 2  # 20, before which nothing is compared, and 21
    assert log.backwards == [*range(1, 20), *range(22, 41)]


def test_a_nan_that_stays_in_a_parameter_is_no_drift(recwarn):
    """The model has a hole, but nothing of the loop's moves it in skipped iterations."""
    module = stranger(extra="gaussians.values['f_rest'].data[0] = float('nan')")
    with SkipGate(module, policy=SkipAlways()) as gate:
        train(module)
        assert gate.patched
    assert gate.report()["backwards_skipped"] == 21 and not [w for w in recwarn if "moved" in str(w.message)]


def test_what_moves_beside_a_nan_is_still_found():
    module = stranger(extra="gaussians.values['f_rest'].data[0] = float('nan'); gaussians.shake()")
    with pytest.warns(RuntimeWarning), SkipGate(module, policy=SkipAlways()) as gate:
        train(module)
    assert not gate.patched
