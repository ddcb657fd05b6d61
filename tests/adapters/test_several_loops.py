"""A training function with several loops, one after the other: each is read when it begins."""

import pytest
from cases import SkipAlways, note_begun
from lookalikes import gsplat_runner, inria
from lookalikes.splats import log, new_log
from test_unknown_changes import forked

from skipgs_plug import SkipGate, SkipGSError

LOOP = "    for iteration in range(first_iter, opt.last + 1):\n"
WARM_UP = """    for iteration in range(1, 11):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        photo_loss(render(viewpoint_cam, gaussians, pipe, None)["render"], viewpoint_cam).backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad(set_to_none=True)
    for _ in range(100):  # passes the number with which the next loop begins
        pass
    for iteration in range(11, opt.last + 1):
"""
WHOLE = list(range(inria.FIRST, inria.LAST + 1))


@pytest.fixture
def begun(monkeypatch):
    """Numbers of the iterations that began."""
    return note_begun(monkeypatch)


def train(fork, **settings):
    new_log()
    with SkipGate(fork, pause_iters=0, **settings) as gate:
        fork.train()
    return gate


@pytest.mark.parametrize("settings", [{"share": 0.4}, {"refine_share": 0.4}], ids=["share", "refine_share"])
@pytest.mark.parametrize("split", [8, inria.START, 41], ids=["growing", "between", "refining"])
def test_a_loop_in_two_parts_leaves_out_the_same_as_in_one(split, settings, begun, tmp_path):
    train(inria, **settings)
    whole, structure = list(begun), log.structure
    begun.clear()
    parts = f"    for part in [(first_iter, {split}), ({split}, opt.last + 1)]:\n      for iteration in range(*part):\n"
    gate = train(forked(inria, [(LOOP, parts)], tmp_path), **settings)
    assert begun == whole and len(whole) < len(WHOLE)
    assert log.structure == structure and gate.released is None


def test_a_loop_that_does_not_densify_runs_whole_with_one_warning(begun, tmp_path):
    fork = forked(inria, [(LOOP, WARM_UP)], tmp_path)
    with pytest.warns(RuntimeWarning, match="events of iterations 2 to 10 are not known") as said:
        gate = train(fork, share=0.4)
    assert len(said) == 1 and gate.released is None
    grown = [n for n in begun if n < inria.START]
    assert grown[:10] == WHOLE[:10] and len(grown) < inria.START - 1
    report = gate.report()
    assert report["growing"]["iterations_skipped"] > 0 and report["iterations_skipped"] > 0 and begun[-1] == inria.LAST


SECOND = """    for iteration in range(first_iter, 31):
{body}
    iteration, upcoming = 30, 40
{head}
"""


@pytest.mark.parametrize(
    ("head", "sentence"),
    [
        (
            "    while iteration < opt.last:\n        iteration += 1\n",
            r"in iteration 40.*No loop over range\(...\) .*\(line \d+ of .*: while iteration < opt.last\), so",
        ),
        (
            "    for iteration in range(31, opt.last + 1):\n        if iteration == upcoming:\n"
            "            upcoming += 10\n",
            r"in iteration 31.*\(iteration == upcoming\)",
        ),
        ("    for iteration in range(31, opt.last + 11):\n", "in iteration 31.*up to 70 come after a plan that ends"),
    ],
    ids=["no range", "condition", "beyond the end"],
)
def test_a_later_loop_that_cannot_be_planned_runs_whole_with_one_warning(head, sentence, begun, tmp_path):
    with open(inria.__file__, encoding="utf-8") as file:
        body = file.read().partition(LOOP)[2].partition("    return gaussians.capture()")[0]
    second = SECOND.format(body=body.rstrip(), head=head.rstrip()) + body
    fork = forked(inria, [(LOOP + body, second)], tmp_path)
    with pytest.warns(RuntimeWarning, match=sentence) as said:
        gate = train(fork, refine_share=0.4, compensate=False)
    assert [str(one.message) for one in said] == [gate.released]
    assert [n for n in begun if n < 31] != WHOLE[:30] and gate.patched == []
    assert sorted(n for n in log.backwards if n > 30) == list(range(31, max(log.backwards) + 1))


LOADER = """    iteration, views, batches = first_iter - 1, scene.getTrainCameras(), []
    while iteration < opt.last:
      for batch in views:
        if iteration == opt.last:
            break
        iteration += 1
"""


@pytest.mark.parametrize("settings", [{"share": 0.4}, {"refine_share": "auto"}], ids=["share", "refine_share"])
def test_a_loop_over_a_data_loader_refuses_a_share_before_anything_runs(settings, begun, tmp_path):
    """So do hierarchical-3d-gaussians, whose bar alone counts with a range."""
    with pytest.raises(SkipGSError, match=r"does not count with range\(\); give neither share nor refine_share"):
        SkipGate(forked(inria, [(LOOP, LOADER)], tmp_path), **settings)
    assert begun == []


def test_the_papers_gate_follows_a_loop_over_a_data_loader(begun, tmp_path):
    gate = train(forked(inria, [(LOOP, LOADER)], tmp_path), policy=SkipAlways())
    assert begun == WHOLE and gate.report()["backwards_skipped"] > 30


EPOCHS = """        step = -1
        for epoch in range((last + 1) // 5):
          for _ in [0] * 5:
            step += 1
"""


def test_a_loop_over_epochs_that_begins_with_the_same_number_leaves_out_nothing(begun, tmp_path):
    fork = forked(gsplat_runner, [("        for step in range(last + 1):\n", EPOCHS)], tmp_path)
    runner = fork.Runner(fork.DefaultStrategy())
    new_log()
    with SkipGate(runner, share=0.4) as gate, pytest.warns(RuntimeWarning, match="No loop over range") as said:
        runner.train()
    assert [str(one.message) for one in said] == [gate.released]
    assert begun == list(range(gsplat_runner.LAST + 1))
