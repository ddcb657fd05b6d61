"""A trainer that does not fit its adapter is refused before training, with one sentence about the difference."""

import copy
import types

import pytest
import torch
from cases import RULE, SCRIPTS, run, script
from lookalikes import fastgs, inria, speedy_splat, taming
from lookalikes.splats import NAMES, Scene, SplatModel, dataset, draw, make_cameras, new_log, photo_loss, pick

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError, UnknownTrainerError
from skipgs_plug.adapters import register_adapter, registry
from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.adapters.registry import adapter_names
from skipgs_plug.core.caution import GateWarning


def test_unknown_trainer_gets_the_list_and_the_manual_form():
    with pytest.raises(UnknownTrainerError) as error:
        SkipGate(object())
    message = str(error.value)
    assert all(name in message for name in adapter_names())
    assert "SkipGate(start_iter=...)" in message and "gate.backward(loss, view, step)" in message


def test_unknown_adapter_gets_the_list():
    with pytest.raises(UnknownTrainerError, match=r"no adapter 'fastsg'; there are .*fastgs"):
        SkipGate(inria, adapter="fastsg")


@pytest.mark.parametrize("name", ["fastgs", "taming", "speedy_splat", "lightgaussian", "gaussianspa"])
def test_wrong_fork_is_named_with_the_right_one(name):
    module = speedy_splat if name == "taming" else inria
    with pytest.raises(AdapterMismatchError) as error:
        SkipGate(module, adapter=name)
    assert f"Adapter {name!r}" in str(error.value)
    assert f"looks like the training script of {module.ADAPTER!r}" in str(error.value)


def test_a_named_adapter_that_takes_unknown_forks_is_used_with_a_warning():
    new_log()
    with pytest.warns(GateWarning) as said, SkipGate(copied(speedy_splat), adapter="inria") as gate:
        assert gate.adapter.name == "inria"
    assert "looks like the training script of 'speedy_splat', whose adapter knows more" in str(said[0].message)


def test_wrong_fork_of_a_script_is_noticed_in_its_first_iteration():
    new_log()
    module = copied(speedy_splat)
    with SkipGate(copied(taming)) as gate:
        adapter, hooks = gate.adapter, gate._hooks
        gate.detach()
        adapter._attach_to_model(hooks, vars(module))  # attach_script makes this call
        with pytest.raises(AdapterMismatchError, match="looks like the training script of 'speedy_splat'"):
            module.training(dataset(), types.SimpleNamespace(last=5, iterations=5), None)


@pytest.mark.parametrize("name", ["gsplat", "step_trainer", "nerfstudio", "inria"])
def test_named_adapter_on_something_else_says_what_it_expects(name):
    with pytest.raises(AdapterMismatchError, match=f"Adapter '{name}' expects"):
        SkipGate(types.SimpleNamespace(), adapter=name)


def copied(module):
    """The same module anew, to be spoilt."""
    copy_of = types.ModuleType(module.__name__)
    copy_of.__dict__.update({k: v for k, v in vars(module).items() if not k.startswith("__")})
    for name, value in vars(module).items():
        if isinstance(value, types.FunctionType) and value.__module__ == module.__name__:
            setattr(copy_of, name, types.FunctionType(value.__code__, vars(copy_of), name, value.__defaults__))
    copy_of.GaussianModel = type("GaussianModel", module.GaussianModel.__bases__, dict(vars(module.GaussianModel)))
    return copy_of


# An iteration of Deformable begins with its render, since its learning rates are set at the end.
BEGUN_BY_METHOD = [case for case in SCRIPTS if case.name != "deformable"]


@pytest.mark.parametrize("case", BEGUN_BY_METHOD, ids=lambda case: case.name)
def test_renamed_method_is_named(case, monkeypatch):
    monkeypatch.delattr(SplatModel, "update_learning_rate")
    if "update_learning_rate" in vars(case.module.GaussianModel):
        monkeypatch.delattr(case.module.GaussianModel, "update_learning_rate")
    with pytest.raises(AdapterMismatchError, match=r"GaussianModel\.update_learning_rate does not exist\. Adapter '"):
        SkipGate(case.module)
    assert torch.Tensor.backward.__module__ == "torch._tensor"


def test_renamed_renderer_is_named():
    module = copied(fastgs)
    module.FORK = module.render_fastgs
    del module.render_fastgs
    with pytest.raises(AdapterMismatchError, match="Adapter 'fastgs'"):
        SkipGate(module, adapter="fastgs")


TRAIN = """
def training(dataset, opt, pipe):
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    for iteration in range(1, opt.iterations + 1):
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        loss = photo_loss(render(viewpoint_cam, gaussians)["render"], viewpoint_cam)
        {backward}
        if iteration < opt.densify_until_iter:
            pass  # densification
        done.append(iteration)
"""


def train_module(backward):
    """A training module in Inria's shape with this line in the place of the backward."""
    module = types.ModuleType("train")
    module.__dict__.update(
        GaussianModel=type("GaussianModel", (SplatModel,), {}),
        Scene=Scene,
        pick=pick,
        photo_loss=photo_loss,
        torch=torch,
        done=[],
        render=lambda camera, gaussians: draw(camera, gaussians.values),
    )
    exec(TRAIN.format(backward=backward), vars(module))
    return module


BACKWARDS = {
    "none": "loss.backward",
    "other": "torch.autograd.backward([loss, loss])",
    "two": "loss.backward(); render(viewpoint_cam, gaussians)['render'].mean().backward()",
}


@pytest.mark.parametrize("backward", BACKWARDS.values(), ids=BACKWARDS)
def test_not_one_backward_per_iteration_releases_the_gate_after_ten_and_loses_no_run(backward):
    module = train_module(backward)
    opt = types.SimpleNamespace(iterations=40, densify_until_iter=20)
    with SkipGate(module) as gate:
        with pytest.warns(RuntimeWarning, match="goes on without it, .* where one per iteration was expected") as seen:
            module.training(dataset(), opt, None)
        assert not gate.patched
    assert module.done == list(range(1, 41))
    warning = next(one.message for one in seen if one.category is GateWarning)
    assert "8a70a8cd" in str(warning) and "8a70a8cd" in gate.released


def test_backward_of_autograd_is_gated_as_that_of_the_loss():
    gated = []
    for backward in ("loss.backward()", "torch.autograd.backward(loss)"):
        module = train_module(backward)
        with SkipGate(module) as gate:
            module.training(dataset(), types.SimpleNamespace(iterations=200, densify_until_iter=20), None)
        assert gate.released is None
        gated.append(gate.stats()["gated_iterations"])
    assert gated == [181, 181]


def test_script_shorter_than_ten_iterations_is_judged_at_its_end():
    module = train_module("loss.backward")
    with SkipGate(module) as gate:
        module.training(dataset(), types.SimpleNamespace(iterations=4, densify_until_iter=2), None)
    with pytest.raises(AdapterMismatchError, match="0 training backwards were seen in 4 iterations"):
        gate.verify()


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("opt", r"training\(\) has no variable 'opt'"), ("scene", r"expects scene among the variables of training\(\)")],
)
def test_renamed_variable_of_the_loop_is_named(name, sentence):
    module = train_module("loss.backward()")
    exec(TRAIN.format(backward="loss.backward()").replace(name, "renamed"), vars(module))
    opt = types.SimpleNamespace(iterations=40, densify_until_iter=20)
    with pytest.raises(AdapterMismatchError, match=sentence), SkipGate(module):
        module.training(dataset(), opt, None)


def test_state_of_another_scene_is_refused_before_the_first_iteration():
    _, gate = run(script("inria", inria), **RULE)
    state = gate.state_dict()
    state["stats"]["views"]["garden.jpg"] = state["stats"]["views"].pop(next(iter(state["stats"]["views"])))
    new_log()
    with SkipGate(inria, **RULE) as other:
        other.load_state_dict(state)
        with pytest.raises(SkipGSError, match=r"belongs to another scene: it knows view 'garden\.jpg'"):
            inria.train()


def test_views_of_the_same_name_are_told_apart_by_position(monkeypatch):
    cameras = make_cameras()
    for camera in cameras:
        camera.image_name = camera.image_name.rsplit("/", 1)[1]
    run_of = types.SimpleNamespace(model_path="output", cameras=cameras, white_background=False)
    monkeypatch.setattr(inria, "dataset", lambda order: run_of)
    monkeypatch.setattr(inria, "pick", lambda cameras, iteration: cameras[iteration % len(cameras)])
    with pytest.warns(RuntimeWarning, match="same name"):
        _, gate = run(script("inria", inria), **RULE)
    assert {row["view"] for row in gate.view_table()} == {str(i) for i in range(len(NAMES))}


def test_early_start_is_refused_where_gradients_are_read():
    with pytest.raises(SkipGSError, match="start_iter=19 is too early: up to iteration 20"):
        run(script("inria", inria), start_iter=19)
    run(script("inria", inria), start_iter=20)


class Marked(InriaFamily):
    """A fork that is known by a name."""

    name, checked, mark = "mine", "my fork of Inria 3DGS", "MY_FORK"

    def start_iter(self, opt, loop):
        return 30


class Recognised(Marked):
    """A fork that is known by something else."""

    mark = ""

    @classmethod
    def recognises(cls, names):
        return "MY_FORK" in names


@pytest.mark.parametrize("mine", [Marked, Recognised])
def test_user_adapter_of_a_fork_is_asked_first(mine):

    module = copied(inria)
    module.MY_FORK = True
    try:
        register_adapter(mine)
        with SkipGate(module) as gate:
            assert gate.adapter.name == "mine"
        with SkipGate(inria) as gate:
            assert gate.adapter.name == "inria"
        with pytest.raises(AdapterMismatchError, match=r"'mine' is for my fork .* training script of 'inria'"):
            SkipGate(inria, adapter="mine")
        SkipGate(module, adapter="inria").detach()  # an adapter chosen by name accepts forks
    finally:
        registry._registered.pop("mine", None)
    assert copy.copy(adapter_names())[0] == "reference"


def test_cameras_without_a_name_are_refused_with_the_name():
    module = train_module("loss.backward()")

    class Nameless(Scene):
        def getTrainCameras(self):
            return [types.SimpleNamespace(original_image=one.original_image) for one in super().getTrainCameras()]

    module.Scene = Nameless
    with SkipGate(module), pytest.raises(AdapterMismatchError, match="expects cameras with an attribute image_name"):
        module.training(dataset(), types.SimpleNamespace(iterations=5, densify_until_iter=2), None)


def test_an_iteration_after_the_run_cannot_be_named():
    module = train_module("loss.backward()")
    with SkipGate(module, share=0.5, always=[4, 9]), pytest.raises(SkipGSError, match="names iteration 9, and the run"):
        module.training(dataset(), types.SimpleNamespace(iterations=5, densify_until_iter=2), None)


MARKS = ["num_depth", "depth_reinit", "OptimizingSpa", "compute_edge_score", "set_coarse_interval"]


@pytest.mark.parametrize("name", MARKS)
def test_a_mark_alone_makes_a_script_no_fork_of_that_name(name):
    module = train_module("loss.backward()")
    setattr(module, name, None)
    with SkipGate(module) as gate:
        assert gate.adapter.name == "inria"
