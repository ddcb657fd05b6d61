"""Forks that no adapter knows are refused, warned about, or run without a gate, as their loop requires."""

import pytest
import torch
from cases import SkipAlways
from lookalikes.splats import log
from unknown_fork import HELPERS, INNER, TRAIN, train, unknown_fork

from skipgs_plug import AdapterMismatchError, SkipGate
from skipgs_plug.adapters.inria import Inria
from skipgs_plug.adapters.registry import find_script_adapter


def test_inrias_own_loop_is_not_an_unknown_fork():
    with SkipGate(unknown_fork(), policy=SkipAlways()) as gate:
        assert gate.adapter.name == "inria"
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


def test_fork_that_culls_as_scaffold_gs_does_but_has_no_anchors_is_inrias():
    module = unknown_fork()
    module.prefilter_voxel = module.render  # Spec-Gaussian
    with SkipGate(module) as gate:
        assert gate.adapter.name == "inria"


def test_loop_that_clamps_values_is_gated():
    """A clamp changes nothing in a skipped iteration, in which nothing moves: GaussianShader clamps its light."""
    with SkipGate(unknown_fork(extra="gaussians.values['opacity'].clamp_(max=1.0)"), policy=SkipAlways()) as gate:
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


@pytest.mark.parametrize(
    ("extra", "sentence"),
    [
        ("gaussians.values['xyz'].add_(torch.randn(30, 3))", r"itself changes values \(add_, randn\)"),
        ("gaussians.values['xyz'].data += 0.1", r"itself changes values \(data\)"),
        ("gaussians.values['xyz'].add_(0.1)", r"itself changes values \(add_\)"),
        ("[v.mul_(0.9) for v in gaussians.values.values()]", r"itself changes values \(mul_\)"),
    ],
)
def test_loop_that_changes_values_itself_is_refused(extra, sentence):
    with pytest.raises(AdapterMismatchError, match=sentence):
        SkipGate(unknown_fork(extra=extra))
    assert torch.Tensor.backward.__module__ == "torch._tensor"


@pytest.mark.parametrize("write", ["gaussians.values['xyz'].add_(0.1)", "gaussians.values['xyz'].data += 0.1"])
def test_loop_that_changes_values_behind_an_option_is_refused_only_if_it_is_on(from_file, write):
    module = from_file(extra=f"if opt.shakes: {write}")
    with SkipGate(module, policy=SkipAlways()) as gate:
        train(module, shakes=False)
    assert gate.report()["backwards_skipped"] == 21
    with SkipGate(module), pytest.raises(AdapterMismatchError, match="itself changes values"):
        train(module, shakes=True)
    assert log.backwards == []


def test_loop_without_an_end_of_densification_is_refused():
    with pytest.raises(AdapterMismatchError, match="its loop never asks for densify_until_iter"):
        SkipGate(unknown_fork(densification="pass"))


NESTED = """if not opt.features:
                if iteration < opt.densify_until_iter:
                    gaussians.densify_and_prune(0.05)"""
JOINED = "if iteration < opt.densify_until_iter and not opt.features: gaussians.densify_and_prune(0.05)"
ELSEWHERE = """if iteration < opt.densify_until_iter:
                if opt.features: list(gaussians.values)
                else: gaussians.densify_and_prune(0.05)"""
PRUNED = f"{NESTED}\n            if iteration == 6: gaussians.prune_points(torch.zeros(30, dtype=torch.bool))"
READ, THINNED = (f"{NESTED}\n            {call}" for call in ("gaussians.get_features()", "gaussians.thin()"))


@pytest.mark.filterwarnings("ignore:The (gate|densification)", "ignore:.*Not recognised")
@pytest.mark.parametrize(
    ("densification", "start"),
    [(NESTED, 1), (JOINED, 1), (ELSEWHERE, 20), (PRUNED, 7), (READ, 1), (THINNED, 20)],
)
@pytest.mark.parametrize("settings", [{}, {"share": 0.4}, {"refine_share": 0.4}], ids=["paper", "share", "refined"])
def test_a_loop_that_never_densifies_is_refined_from_its_beginning(densification, start, settings, from_file):
    """LangSplat fits features to finished Gaussians."""
    with SkipGate(from_file(densification=densification), **settings, pause_iters=0) as gate:
        train(gate.adapter.trainer, features=True)
    report = gate.report()
    assert gate.config.start_iter == start
    if settings and start < 20:
        assert report["growing"] is None
        assert report["iterations_run"] + report["iterations_skipped"] == 41 - max(start, 1)
        assert report["iterations_skipped"] > 15


def test_a_loop_that_never_densifies_can_be_gated_from_any_iteration(from_file):
    with SkipGate(from_file(densification=NESTED), start_iter=5, policy=SkipAlways()) as gate:
        train(gate.adapter.trainer, features=True)
    assert gate.report()["backwards_skipped"] == 36


def test_further_calls_and_arguments_are_listed():
    with pytest.warns(RuntimeWarning, match="that no adapter knows") as warnings:
        gate = SkipGate(unknown_fork(", kernel_size=0.1", "gaussians.count()"), policy=SkipAlways())
    sentence = str(warnings[0].message)
    assert "Recognised: render, backward, training_setup, update_learning_rate." in sentence
    assert sentence.endswith("still executed in skipped iterations: render(kernel_size=), count().")
    with gate:
        train(gate.adapter.trainer)  # no parameter moves in skipped iterations, so the gate stays to the end
    assert gate.report()["backwards_skipped"] == 21


@pytest.mark.parametrize(
    "when",
    [
        "iteration / opt.iterations in (0.65, 0.8)",
        "iteration // 6 == 4 and iteration % 2",
        "iteration in torch.tensor([26, 32]).tolist()",
    ],
)
def test_gaussians_that_a_fork_removes_unseen_pause_the_gate(when):
    fork = unknown_fork(extra=f"if {when}: getattr(gaussians, 'th' + 'in')()")
    with SkipGate(fork, pause_iters=2, warmup=0, min_bwd_ratio=0.0, record_trace=True) as gate:
        train(fork)
    changed = [n for n in range(20, 40) if len(log.values[n][0]) != len(log.values[n + 1][0])]
    assert gate.released is None and len(changed) in (2, 3)
    paused = {row.step for row in gate.trace if row.reason == "pause"}
    assert {n + 1 for n in changed} | {n + 2 for n in changed} <= paused
    assert gate.report()["events"] == {"number of Gaussians": len(changed)}


def test_what_moves_the_model_in_skipped_iterations_ends_the_gate_and_not_the_training():
    with pytest.warns(RuntimeWarning, match=r"shake\(\)"):
        gate = SkipGate(unknown_fork(extra="gaussians.shake()"), policy=SkipAlways())
    with gate, pytest.warns(RuntimeWarning, match="The loop moved xyz in iteration 21, whose backward was skipped"):
        train(gate.adapter.trainer)
        assert not gate.patched
    assert gate.report()["backwards_skipped"] == 2  # in iteration 20, which has nothing to compare with, and in 21
    assert log.backwards == [*range(1, 20), *range(22, 41)]


def test_a_nan_that_stays_in_a_parameter_is_no_drift(recwarn):
    """The model has a hole, but nothing of the loop's moves it in skipped iterations."""
    module = unknown_fork(extra="gaussians.values['f_rest'].data[0] = float('nan')")
    with SkipGate(module, policy=SkipAlways()) as gate:
        train(module)
        assert gate.patched
    assert gate.report()["backwards_skipped"] == 21 and not [w for w in recwarn if "moved" in str(w.message)]


def test_what_moves_beside_a_nan_is_still_found():
    module = unknown_fork(extra="gaussians.values['f_rest'].data[0] = float('nan'); gaussians.shake()")
    with pytest.warns(RuntimeWarning), SkipGate(module, policy=SkipAlways()) as gate:
        train(module)
    assert not gate.patched


def test_noise_for_a_network_is_listed_and_not_refused():
    with pytest.warns(RuntimeWarning, match=r"still executed in skipped iterations: randn\(\)"):
        gate = SkipGate(unknown_fork(extra="noise = torch.randn(3)"), policy=SkipAlways())
    with gate:
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


def test_an_attribute_with_the_name_of_a_noise_is_none(from_file, recwarn):
    SkipGate(from_file(extra="viewpoint_cam.normal = normal = None; viewpoint_cam.normal")).detach()
    assert not recwarn.list
    helper = "\ndef shaken(camera):\n    return torch.normal(0.0, 1.0, (3,))\n"
    with pytest.warns(RuntimeWarning, match=r"still executed in skipped iterations: normal\(\)"):
        SkipGate(from_file(extra="viewpoint_cam.normal; shaken(viewpoint_cam)", helper=helper)).detach()


def test_a_filter_of_positions_puts_no_start_off(from_file, recwarn):
    fork = from_file(extra="if iteration < opt.prune_until_iter: gaussians.compute_3D_filter()")
    with SkipGate(fork, policy=SkipAlways()) as gate:
        train(fork)
    assert gate.config.start_iter == 20 and gate.released is None and not recwarn.list


@pytest.mark.parametrize(
    "parts",
    [
        {"before": "gaussians.values['xyz'].requires_grad_(False).requires_grad_(True)"},
        {"before": "torch.zeros(3).fill_(1.0)"},
        {"after": "torch.zeros(3).fill_(1.0)"},
        {"extra": "torch.zeros(3).requires_grad_(False)"},
    ],
    ids=["freeze before", "write before", "write after", "freeze"],
)
def test_what_changes_no_values_in_the_loop_is_not_refused(from_file, parts):
    with SkipGate(from_file(**parts), policy=SkipAlways()) as gate:
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


def test_failure_of_the_gates_own_code_loses_no_run(monkeypatch):
    def broken(self, opt, loop):
        return opt.no_such_option

    monkeypatch.setattr(Inria, "start_iter", broken)
    sentence = "goes on without it, .*AttributeError: .*no_such_option"
    with SkipGate(unknown_fork()) as gate:
        with pytest.warns(RuntimeWarning, match=sentence):
            train(gate.adapter.trainer)
        assert not gate.patched
    assert log.backwards == [*range(1, 41)]


def test_a_gate_that_is_off_counts_iterations_with_several_backwards(recwarn):
    fork = unknown_fork(extra="with torch.enable_grad(): render(viewpoint_cam, gaussians)['render'].sum().backward()")
    with SkipGate(fork, enabled=False) as gate:
        train(fork)
    assert not list(recwarn) and gate.report()["iterations"] == 40
    with SkipGate(fork) as gate, pytest.warns(RuntimeWarning, match="20 training backwards were seen in 10 iterations"):
        train(fork)


def test_a_gate_that_is_off_refuses_nothing_in_the_first_iteration(monkeypatch):
    monkeypatch.setattr(Inria, "scenes", ("no_scene",))
    sentence = "expects no_scene among the variables"
    off = f"Training goes on, but its counts and times end .*{sentence}"
    with SkipGate(unknown_fork(), enabled=False) as gate, pytest.warns(RuntimeWarning, match=off):
        train(gate.adapter.trainer)
    assert log.backwards == [*range(1, 41)]
    with SkipGate(unknown_fork()) as gate, pytest.raises(AdapterMismatchError, match="expects no_scene"):
        train(gate.adapter.trainer)


OTHER_WAYS = {
    "number of another name": [("iteration", "it"), ("opt.its", "opt.iterations")],
    "rates in a helper": [("gaussians.update_learning_rate(iteration)", "set_rates(gaussians, iteration)")],
    "camera by keyword": [("render(viewpoint_cam, gaussians", "render(viewpoint_camera=viewpoint_cam, pc=gaussians")],
    "backward in a helper": [("loss.backward()", "optimise(loss)")],
    "backward in an inner function": [("loss.backward()", "inner(loss)"), ("\n    pass", f"\n    {INNER}")],
    "loop in an inner function": [
        ("    for iteration", "    def run(*, opt=opt, scene=scene):\n     for iteration"),
        ("{after}", "run()"),
    ],
    "backward in a lambda": [
        ("loss.backward()", "inner(loss)"),
        ("\n    pass", "\n    inner = lambda one: one.backward()"),
    ],
}


@pytest.mark.parametrize("way", OTHER_WAYS)
def test_a_loop_that_does_the_same_in_other_words_is_gated(way, tmp_path, monkeypatch):
    source = TRAIN
    for old, new in (("{before}", "pass"), *OTHER_WAYS[way]):
        source = source.replace(old, new)
    monkeypatch.setattr("unknown_fork.TRAIN", source)
    fork = unknown_fork(helper=HELPERS, file=tmp_path / "train.py")
    with SkipGate(fork, policy=SkipAlways()) as gate:
        train(fork)
    assert gate.released is None and gate.report()["backwards_skipped"] == 21


@pytest.mark.parametrize(("name", "extra"), [("inria", "pass"), ("2dgs", "lambda_dist = opt.lambda_dist")])
def test_the_viewer_that_2dgs_shares_with_other_forks_does_not_make_a_script_its_own(name, extra, tmp_path):
    shows = "render_net_image(None, dataset.render_items, None, None)"
    text = TRAIN.format(before="pass", argument="", extra=extra, after=shows)
    script = tmp_path / "train.py"
    script.write_text(f"from scene import GaussianModel\nfrom utils.image_utils import render_net_image\n{text}")
    assert find_script_adapter(script).name == name
