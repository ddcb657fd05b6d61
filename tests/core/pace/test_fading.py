"""Points that a scene begins with and that fade: random ones in empty space."""

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.core.caution import GateWarning
from skipgs_plug.core.pace.fading import Fading
from skipgs_plug.core.pace.needs import GROWING_SIGHTS_FROM_RANDOM, GROWING_STEPS_FROM_RANDOM, growing_share

ROWS, START, LAST = 40, 4000, 6000
VIEWS = [f"{i}.png" for i in range(4)]


def stepped(falling, unmoved=0):
    """Return what `Fading` says of a step in which so many of 40 opacities fall."""
    opacities = torch.nn.Parameter(torch.rand(ROWS, 1))
    fading = Fading()
    for _ in range(3):
        fading.see(opacities)
        with torch.no_grad():
            opacities[:falling] -= 0.05
            opacities[falling : ROWS - unmoved] += 0.05
    return fading.finish()


@pytest.mark.parametrize(
    "falling, unmoved, expected", [(16, 0, False), (20, 0, False), (26, 0, True), (40, 0, True), (8, 28, True)]
)
def test_it_is_most_of_the_opacities_that_moved(falling, unmoved, expected):
    assert stepped(falling, unmoved) == expected


def test_nothing_is_said_of_other_tensors_or_of_none():
    assert not Fading().finish()
    fading = Fading()
    fading.see(torch.rand(ROWS, 1))
    fading.see(torch.rand(ROWS + 1, 1))
    assert not fading.finish()


def test_nothing_is_kept_after_the_answer():
    fading, opacities = Fading(), torch.ones(ROWS, 1)
    fading.see(opacities)
    fading.finish()
    opacities -= 1.0
    fading.see(opacities)
    assert not fading.finish()


def test_a_scene_of_random_points_needs_more_iterations():
    assert growing_share(3500, 100, longer=True, shown_of_random=1.0) == GROWING_STEPS_FROM_RANDOM / 3500
    assert growing_share(1500, 17, longer=True, shown_of_random=1.0) == 1.0
    seldom_shown = growing_share(15_000, 255, longer=True, shown_of_random=0.2)
    assert seldom_shown == pytest.approx(5 * GROWING_SIGHTS_FROM_RANDOM / 15_000)
    # Points that are moved need not fade.
    assert growing_share(5832, 255, longer=True, shown_of_random=0.1, moved=True) == pytest.approx(2700 / 5832)
    assert growing_share(15_000, 100, longer=True, shown_of_random=1.0, moved=True) == 0.1


def train(gate, direction, until=LAST, note=None):
    """Train a model whose opacities rise or fall, and return the number of iterations before refinement.

    `note` is called before each step.
    """
    means, scales = torch.nn.Parameter(torch.randn(ROWS, 3)), torch.nn.Parameter(torch.randn(ROWS, 3))
    opacities = torch.nn.Parameter(torch.rand(ROWS, 1))
    named = {"xyz": means, "opacity": opacities, "scaling": scales}
    optimizer = torch.optim.Adam([{"params": [param], "name": name} for name, param in named.items()], lr=0.01)
    if note is not None:
        optimizer.register_step_pre_hook(note)
    ran = 0
    for step in gate.iterations(range(LAST), views=VIEWS, events=range(100, START, 100)):
        ran += step < START
        loss = means.square().sum() + scales.square().sum() - direction * opacities.sum()
        if gate.backward(loss, view=VIEWS[step % 4], step=step):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if step >= until:
            break
    return ran


@pytest.mark.parametrize("direction", [1, -1])
def test_with_auto_the_first_steps_decide(direction):
    with SkipGate(start_iter=START, share="auto") as gate:
        ran = train(gate, direction)
    growing = gate.report()["growing"]
    assert growing["fading"] == (direction < 0)
    least = GROWING_STEPS_FROM_RANDOM if direction < 0 else 0
    assert ran == growing["iterations_run"] >= least
    assert (growing["share"] == GROWING_STEPS_FROM_RANDOM / START) == (direction < 0)
    assert ("random" in gate.summary()) == (direction < 0)


def test_a_state_keeps_the_answer():
    with SkipGate(start_iter=START, share="auto") as gate:
        train(gate, -1, until=500)
        state = gate.state_dict()
    with SkipGate(start_iter=START, share="auto") as again:
        again.load_state_dict(state)
        assert again.state_dict()["pace"]["growing"]["fading"]


@pytest.mark.parametrize("share, compensate, warned", [(0.3, True, True), (0.5, True, False), (0.3, False, False)])
def test_a_share_that_is_too_small_for_random_points_is_warned_of(share, compensate, warned):
    with SkipGate(start_iter=START, share=share, compensate=compensate) as gate:
        if warned:
            with pytest.warns(GateWarning, match=r"grow_share=0\.44 or"):
                train(gate, -1, until=100)
        else:
            train(gate, -1, until=100)


def test_scales_keep_their_rate_and_positions_take_the_common_factor():
    rates = []

    def note(optimizer, args, kwargs):
        rates.append([group["lr"] / 0.01 for group in optimizer.param_groups])

    with SkipGate(start_iter=START, share="auto") as gate:
        train(gate, -1, until=500, note=note)
    factor = gate.report()["growing"]["rate_factor"]
    assert factor > 1.0
    opacities = (START / GROWING_STEPS_FROM_RANDOM) ** 0.5
    assert rates[-1] == pytest.approx([factor, opacities, 1.0])
