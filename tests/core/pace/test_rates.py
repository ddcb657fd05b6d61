"""Learning rates scaled for the length of a step."""

import functools
import threading

import pytest
import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.parts import group_part
from skipgs_plug.core.pace.rates import UNSTEPPED_RAISES, UNSTEPPED_WARNS, ScaledRates, path_factor


def parameter(value=1.0):
    one = torch.nn.Parameter(torch.full((3,), value))
    one.grad = torch.ones(3)
    return one


class Wrapper(torch.optim.Optimizer):
    """An optimizer around another one, with the same groups."""

    def __init__(self, base):
        super().__init__(base.param_groups, {})
        self.base, self.param_groups = base, base.param_groups

    def step(self):
        self.base.step()


def test_optimizers_have_names_where_their_groups_have_none():
    values = {name: torch.nn.Parameter(torch.zeros(5, 3)) for name in ("means", "features_dc", "scales", "opacities")}
    optimizers = {name: torch.optim.SGD([value], lr=0.1) for name, value in values.items()}
    scaled = ScaledRates(lambda: optimizers)
    scaled.scale(3.0)
    for name, value in values.items():
        value.grad = torch.ones(5, 3)
        optimizers[name].step()
    scaled.remove()
    moved = {name: round(-value[0, 0].item() / 0.1, 3) for name, value in values.items()}
    assert moved == {"means": 6.0, "features_dc": 1.5, "scales": 6.0, "opacities": 1.0}
    assert all("name" not in optimizer.param_groups[0] for optimizer in optimizers.values())


def stepped(scaled, factor, optimizers):
    """How far each parameter moves at a gradient of 1, in units of the rate."""
    scaled.scale(factor)
    moved = []
    for optimizer in optimizers:
        (param,) = optimizer.param_groups[0]["params"]
        param.grad = torch.ones_like(param)
        before = param.detach().flatten()[0].item()
        optimizer.step()
        moved.append(round((before - param.detach().flatten()[0].item()) / 0.1, 3))
    return moved


def colours(*higher, together):
    """Optimizers of positions, of the constant band and of higher bands of these shapes, or one of all three."""
    shapes = {"means": (6, 3), "sh0": (6, 1, 3), "shN": higher}
    groups = [{"params": [torch.nn.Parameter(torch.ones(shape))], "name": name} for name, shape in shapes.items()]
    return [torch.optim.SGD(groups, lr=0.1)] if together else [torch.optim.SGD([group], lr=0.1) for group in groups]


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize(("higher", "times"), [((6, 0, 3), 4.0), ((6, 15, 3), 2.0)])
def test_a_constant_band_without_higher_ones_takes_the_common_factor(rates, higher, times, together):
    optimizers = colours(*higher, together=together)
    sh0 = next(group for one in optimizers for group in one.param_groups if group["name"] == "sh0")["params"][0]
    for _ in range(2):  # an optimizer of its own for the higher bands steps after that of the constant one
        rates.scale(4.0)
        before = sh0.detach().clone()
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group["params"][0].grad = torch.ones_like(group["params"][0])
            optimizer.step()
    assert torch.allclose(before - sh0.detach(), torch.tensor(0.1 * times))


@pytest.mark.parametrize(
    "shape", [(7, 3, 4), (7, 9), (64, 32), (5,)], ids=["exposures", "poses", "a layer", "its bias"]
)
def test_what_has_no_row_for_each_gaussian_takes_no_larger_steps(rates, shape):
    groups = {"xyz": (6, 3), "rotation": (6, 4), "another": shape}
    optimizers = [
        torch.optim.SGD([{"params": [torch.nn.Parameter(torch.zeros(size))], "name": name}], lr=0.1)
        for name, size in groups.items()
    ]
    assert stepped(rates, 8.0, optimizers) == [16.0, 8.0, 0.25]
    assert stepped(rates, 0.5, optimizers) == [1.0, 0.5, 0.125]
    assert all(optimizer.param_groups[0]["lr"] == 0.1 for optimizer in optimizers)


@pytest.mark.parametrize(
    "group, shape, moved",
    [
        ({}, (7, 3, 4), 0.25),  # exposures
        ({}, (7, 9), 0.25),  # poses
        ({}, (7, 4), 8.0),  # rotations
        ({}, (7,), 8.0),
        ({}, (7, 15, 3), 32.0),
        ({"name": "anchor_feat"}, (7, 32), 8.0),  # Scaffold-GS has no group of positions
    ],
)
def test_before_the_positions_are_known_shapes_tell(rates, group, shape, moved):
    optimizer = torch.optim.SGD([{"params": [torch.nn.Parameter(torch.zeros(shape))], **group}], lr=0.1)
    assert stepped(rates, 8.0, [optimizer]) == [moved]


def test_without_names_the_positions_are_those_with_more_rows(rates):
    cameras, means, rotations = (
        torch.optim.SGD([torch.nn.Parameter(torch.zeros(size))], lr=0.1) for size in ((4, 3), (9, 3), (9, 4))
    )
    assert stepped(rates, 8.0, [means, cameras, rotations]) == [8.0, 0.25, 8.0]
    assert stepped(rates, 8.0, [cameras, means, rotations]) == [0.25, 8.0, 8.0]


def test_after_a_prune_the_new_number_of_rows_is_known_from_the_next_iteration_on(rates):
    before, after = (torch.optim.SGD([torch.nn.Parameter(torch.zeros(n, 3))], lr=0.1) for n in (9, 6))
    assert stepped(rates, 8.0, [before]) == [8.0]
    assert stepped(rates, 8.0, [after]) == [0.25]
    assert stepped(rates, 8.0, [after]) == [8.0]


def test_the_memory_of_what_takes_no_larger_steps_stays(rates):
    seen = []

    class Noting(torch.optim.Adam):
        def step(self, closure=None):
            seen.append(self.param_groups[0]["betas"][1])
            return super().step(closure)

    for name, size in (("means", (5, 3)), ("exposure", (7, 3, 4))):
        param = torch.nn.Parameter(torch.zeros(size))
        param.grad = torch.ones(size)
        rates.scale(8.0)
        Noting([{"params": [param], "name": name}], lr=0.1).step()
    assert seen == [0.98, 0.999]


def test_the_path_is_conserved():
    steps = 1000
    for share in (0.25, 0.4, 1.0):
        ran = round(share * steps)
        path = sum(path_factor(share, i / ran) for i in range(ran))
        assert path == pytest.approx(steps, rel=0.01)
    # A share below 0.25 gets the steps of 0.25.
    assert path_factor(0.1, 0.0) == path_factor(0.25, 0.0) == pytest.approx(8.0)
    assert path_factor(0.4, 1.0) == 0.0
    assert path_factor(0.4, 0.5, peak=3.0) == 1.5


def test_steps_are_longer_where_there_are_few():
    factor = functools.partial(path_factor, 0.4, 0.5, visible=0.8)
    enough = factor()
    assert factor(steps=1500) == factor(steps=9000) == enough
    assert factor(steps=1500 / 1.44) == pytest.approx(1.2 * enough)
    assert factor(steps=300) == pytest.approx(1.6 * enough)
    assert factor(peak=3.0, steps=300) == 1.5
    # Networks decode the features of models that show no Gaussians, and tolerate no longer steps.
    assert factor(visible=None, steps=300) == factor(visible=None)


@pytest.mark.parametrize(
    "group, shape, times",
    [
        ({"name": "f_rest"}, (5, 15, 3), 4.0),
        ({"name": "sh0"}, (5, 1, 3), 0.5),
        ({"name": "features_dc"}, (5, 3), 0.5),
        ({"name": "offset"}, (5, 10, 3), 1.0),  # Scaffold-GS: positions of the Gaussians of an anchor
        ({"name": "xyz"}, (5, 3), 2.0),
        ({"name": "means3D"}, (5, 3), 2.0),
        ({"name": "point_cloud.position"}, (5, 3), 2.0),
        ({"name": "Background#f_rest"}, (5, 15, 3), 4.0),
        ({"name": "_opacity"}, (5, 1), None),
        ({"name": "mlp_opacity"}, (5, 1), 1.0),  # a network of Scaffold-GS
        ({"name": "scaling"}, (5, 3), 2.0),
        ({"name": "rotation"}, (5, 4), 1.0),
        ({"name": "opacity"}, (5, 1), None),
        ({"name": "opacities"}, (5,), None),
        ({}, (5, 15, 3), 4.0),
        ({}, (5, 1, 3), 0.5),
        ({}, (5, 3), 1.0),
        ({}, (5, 1), None),
        ({}, (5,), 1.0),
    ],
)
def test_groups_of_parameters_take_their_part_of_the_factor(group, shape, times, rates):
    value = torch.nn.Parameter(torch.zeros(shape))
    optimizer = torch.optim.SGD([{"params": [value], **group}], lr=0.1)
    value.grad = torch.ones(shape)
    rates.scale(3.0)
    optimizer.step()
    torch.testing.assert_close(value.detach(), torch.full(shape, -0.1 if times is None else -0.3 * times))
    assert group_part(optimizer.param_groups[0]) == times


class OwnStep(torch.optim.Adam):
    """Like the sparse optimizers of trainers: a step of its own, with arguments, that calls the base's."""

    def step(self, visible, n):
        assert visible and n == 3
        return super().step()


@pytest.mark.parametrize("kind", ["sgd", "adam", "fused", "own", "tensor"])
def test_a_step_is_as_long_as_the_factor_says_and_the_rate_comes_back(kind, rates):
    value, other = parameter(), parameter()
    make = {
        "sgd": lambda p: torch.optim.SGD([p], lr=0.1),
        "adam": lambda p: torch.optim.Adam([p], lr=0.1),
        "fused": lambda p: torch.optim.Adam([p], lr=0.1, fused=True),
        "own": lambda p: OwnStep([p], lr=0.1),
        "tensor": lambda p: torch.optim.SGD([p], lr=torch.tensor(0.1)),
    }[kind]
    arguments = (True, 3) if kind == "own" else ()
    scaled, plain = make(value), make(other)
    rates.scale(4.0)
    before = scaled.param_groups[0]["lr"]
    scaled.step(*arguments)
    assert scaled.param_groups[0]["lr"] is before
    rates.pause()
    plain.step(*arguments)
    torch.testing.assert_close(1.0 - value.detach(), 4.0 * (1.0 - other.detach()), rtol=1e-5, atol=0)


@pytest.mark.parametrize("fused", [False, True])
def test_squares_are_forgotten_sooner_while_steps_are_larger(fused, rates):
    """Larger steps equal those of an Adam whose second beta is 0.98 from the first larger step on."""
    values = parameter(), parameter()
    scaled, sooner = (torch.optim.Adam([value], lr=0.1, fused=fused) for value in values)
    for iteration in range(8):
        for value in values:
            value.grad = torch.tensor([1.0, 0.1, 0.0]) * (iteration % 3)
        larger = iteration >= 3
        if larger:
            rates.scale(1.5)
        scaled.step()
        assert scaled.param_groups[0]["betas"] == (0.9, 0.999)
        rates.pause()
        sooner.param_groups[0].update({"lr": 0.1 * 1.5, "betas": (0.9, 0.98)} if larger else {})
        sooner.step()
    torch.testing.assert_close(values[0], values[1], rtol=0, atol=0)


def test_a_memory_that_is_shorter_already_stays(rates):
    values = parameter(), parameter()
    scaled, plain = (torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.9)) for value in values)
    for _ in range(3):
        rates.scale(1.0)
        scaled.step()
        rates.pause()
        plain.step()
    torch.testing.assert_close(values[0], values[1], rtol=0, atol=0)


def test_a_step_that_raises_gives_its_rate_back_in_the_next_iteration(rates):
    class Broken(torch.optim.SGD):
        def step(self):
            raise ZeroDivisionError

    optimizer = Broken([parameter()], lr=0.1)
    rates.scale(5.0)
    with pytest.raises(ZeroDivisionError):
        optimizer.step()
    rates.scale(5.0)
    assert optimizer.param_groups[0]["lr"] == 0.1
    with pytest.raises(ZeroDivisionError):
        optimizer.step()
    rates.remove()
    assert optimizer.param_groups[0]["lr"] == 0.1


def test_a_checkpoint_after_a_step_that_raised_holds_the_trainers_rates(rates):
    class Broken(torch.optim.Adam):
        def step(self):
            raise KeyboardInterrupt

    broken = Broken([parameter()], lr=0.1)
    before = broken.state_dict()
    for optimizer in (broken, Wrapper(broken)):
        rates.scale(5.0)
        with pytest.raises(KeyboardInterrupt):
            optimizer.step()
        assert broken.param_groups[0]["lr"] == 0.5
        assert broken.state_dict() == before
        rates.pause()
    rates.remove()
    assert not broken._optimizer_state_dict_pre_hooks


def test_a_scheduler_in_a_hook_of_the_optimizer_sets_the_trainers_rate(rates):
    optimizer = torch.optim.SGD([parameter()], lr=0.1)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)
    found = []

    def advance(*_):
        found.append(optimizer.param_groups[0]["lr"])
        schedule.step()

    optimizer.register_step_post_hook(advance)
    for _ in range(2):
        rates.scale(4.0)
        optimizer.step()
    assert found == [0.1, 0.05]
    assert optimizer.param_groups[0]["lr"] == 0.025
    rates.remove()
    assert len(optimizer._optimizer_step_post_hooks) == 1


def test_a_wrapped_optimizer_with_the_same_groups_is_scaled_once(rates):
    value = parameter()
    base = torch.optim.SGD([value], lr=0.1)
    rates.scale(3.0)
    Wrapper(base).step()
    torch.testing.assert_close(1.0 - value.detach(), torch.full((3,), 0.3))
    assert base.param_groups[0]["lr"] == 0.1


def test_an_optimizer_that_is_none_of_pytorchs_is_noticed(rates):
    rates.scale(3.0)
    for _ in range(UNSTEPPED_WARNS - 1):
        rates.ran()
    with pytest.warns(RuntimeWarning, match=r"no torch\.optim\.Optimizer stepped"):
        rates.ran()
    for _ in range(UNSTEPPED_RAISES - UNSTEPPED_WARNS - 1):
        rates.ran()
    with pytest.raises(SkipGSError, match="200 iterations ran with larger steps"):
        rates.ran()
    torch.optim.SGD([parameter()], lr=0.1).step()
    rates.ran()


def test_a_second_one_that_scales_the_same_optimizers_is_refused(rates):
    second, own = ScaledRates(), ScaledRates(list)
    rates.scale(3.0)
    for other in (second, own):
        with pytest.raises(SkipGSError, match=r"each gate would scale the steps of both: detach\(\) it first"):
            other.scale(2.0)
    rates.pause()
    second.scale(2.0)  # allowed: the first gate no longer scales
    second.remove()
    rates.only = list
    rates.scale(3.0)
    own.scale(2.0)  # allowed: each gate knows its own optimizers
    own.remove()


def test_other_threads_and_removed_hooks_are_left_alone(rates):
    def moved():
        value = parameter()
        torch.optim.SGD([value], lr=0.1).step()
        return round(1.0 - value[0].item(), 5)

    rates.scale(3.0)
    seen = []
    thread = threading.Thread(target=lambda: seen.append(moved()))
    thread.start()
    thread.join()
    assert seen == [0.1] and moved() == 0.3
    rates.remove()
    assert moved() == 0.1
    rates.scale(3.0)
    assert moved() == 0.1
