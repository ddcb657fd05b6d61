"""Fewer iterations and fewer densification events while the scene grows."""

import json
import math
from contextlib import nullcontext

import pytest
import torch

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core.caution import GateWarning
from skipgs_plug.core.pace import loop_facts, needs
from skipgs_plug.core.pace.densification_events import LEAST_EVENTS
from skipgs_plug.core.pace.needs import for_new_gaussians, growing_factor
from skipgs_plug.core.pace.phase import PhasePlan
from skipgs_plug.core.pace.visibility import Visibility

VIEWS = [f"{i}.png" for i in range(4)]
INTERVAL, START, LAST = 20, 400, 600


class Loop:
    """A loop that densifies every 20 iterations until 400, saves every 60 and has six Gaussians, all visible."""

    def __init__(self, begin=0, means=None, moments=None):
        self.begin = begin
        self.means = torch.nn.Parameter(torch.arange(18.0).reshape(6, 3) if means is None else means.clone())
        self.optimizer = torch.optim.Adam([{"params": [self.means], "name": "xyz"}], lr=0.1)
        if moments is not None:
            self.optimizer.load_state_dict(moments)
        self.ran, self.grown, self.saved, self.rates = [], [], [], {}

    def train(self, gate, until=LAST, events=range(INTERVAL, START, INTERVAL), end=LAST, **options):
        for step in gate.iterations(range(self.begin, end), views=VIEWS, events=events, **options):
            self.ran.append(step)
            loss = (self.means - step % 3).square().sum()
            if gate.backward(loss, view=VIEWS[step % 4], step=step):
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
            if step % INTERVAL == 0 and 0 < step < START:
                self.grown.append(step)
            if step % 60 == 0:
                self.saved.append(step)
            if step >= until:
                break
        return self


def test_a_share_of_both_phases_runs_and_nothing_that_depends_on_numbers_is_lost():
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop = Loop().train(gate)
    assert loop.saved == list(range(0, LAST, 60))
    grown = [step for step in loop.ran if step < START]
    assert len(grown) == pytest.approx(0.25 * START, abs=2)
    report = gate.report()
    assert report["growing"]["iterations_run"] == len(grown)
    assert report["growing"]["iterations_skipped"] == START - len(grown)
    assert report["growing"]["events_run"] == len(loop.grown)
    assert report["growing"]["events_run"] + report["growing"]["events_skipped"] == len(
        range(INTERVAL, START, INTERVAL)
    )
    assert report["refine_share"] == 0.25 and report["iterations_run"] >= 50
    assert "densification events" in gate.summary()


def test_an_event_waits_until_enough_stands_behind_it():
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop = Loop().train(gate)
    needed = math.ceil(0.25 * START / LEAST_EVENTS)
    chosen = [event for event in loop.grown if event % 60]  # a save must run, and its event with it
    for kept, event in enumerate(chosen, start=1):
        assert sum(step <= event for step in loop.ran) >= kept * needed
    assert 5 <= len(loop.grown) < 19


def test_an_iteration_of_an_event_that_is_not_kept_is_left_out():
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop = Loop().train(gate)
    events = set(range(INTERVAL, START, INTERVAL))
    assert events & set(loop.ran) == set(loop.grown)


def test_rates_stay_while_the_scene_grows_unless_longer_steps_replace_iterations():
    seen = {}

    def note(optimizer, args, kwargs):
        seen[loop.ran[-1]] = optimizer.param_groups[0]["lr"]

    loop = Loop()
    loop.optimizer.register_step_pre_hook(note)
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop.train(gate)
    # Every view shows all Gaussians. Once that is measured, steps are 3 times as long, those of positions 4 times.
    factors = [seen[step] / 0.1 for step in sorted(seen) if step < START]
    assert factors[0] == pytest.approx(1.0) and factors[-1] == pytest.approx(4.0)
    assert gate.report()["growing"]["rate_factor"] == pytest.approx(3.0)


class Opaque(Loop):
    """The same loop with opacities, whose rates it records."""

    def __init__(self):
        super().__init__()
        self.opacities = torch.nn.Parameter(torch.zeros(6, 1))
        self.optimizer.add_param_group({"params": [self.opacities], "name": "opacity", "lr": 0.05})
        self.optimizer.register_step_pre_hook(self.note)

    def note(self, optimizer, args, kwargs):
        self.opacities.grad = -torch.ones_like(self.opacities)  # they rise, as those of points on surfaces do
        groups = zip(optimizer.param_groups, (0.1, 0.05), strict=True)
        self.rates[self.ran[-1]] = tuple(group["lr"] / rate for group, rate in groups)

    def between(self, first, last):
        return {tuple(round(factor, 3) for factor in self.rates[n]) for n in self.rates if first <= n < last}


@pytest.mark.parametrize(("share", "longer"), [(0.25, 4.0), (0.64, 4.0)])
def test_opacities_take_the_root_of_the_path_until_refinement(share, longer):
    loop = Opaque()
    with SkipGate(start_iter=START + 100, share=share) as gate:
        loop.train(gate)
    assert gate.report()["growing"]["opacity_rate_factor"] == pytest.approx(share**-0.5)
    # Visibility is measured by then. The last event is in iteration 380, and refinement begins in iteration 500.
    assert loop.between(200, START + 100) == {(round(longer, 3), round(share**-0.5, 3))}


def test_opacities_alone_take_longer_steps_where_iterations_are_enough(monkeypatch):
    monkeypatch.setattr(needs, "ENOUGH_STEPS", 1)
    loop = Opaque()
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop.train(gate)
    assert loop.between(200, START) == {(1.0, 2.0)}


def test_steps_stay_where_all_iterations_must_run():
    loop = Opaque()
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop.train(gate, always=range(START))
    assert loop.between(0, START) == {(1.0, 1.0)}
    assert loop.ran[:START] == list(range(START)) and len(loop.ran) < LAST


def test_what_must_run_after_the_last_event_does_not_shorten_steps_before_it():
    loop = Opaque()
    with SkipGate(start_iter=START + 100, share=0.16) as gate:
        loop.train(gate, always=range(START, START + 100))
    assert loop.between(200, START) == {(4.0, 2.5)}
    assert loop.between(START, START + 100) == {(1.0, 1.0)}
    assert set(range(START, START + 100)) <= set(loop.ran)


def test_refinement_does_not_end_early_after_few_iterations_of_growth():
    names = [f"{i}.png" for i in range(40)]
    reports = {}
    for kind, settings in {"both": {"share": "auto"}, "refinement": {"refine_share": "auto"}}.items():
        with SkipGate(start_iter=1000, **settings) as gate:
            means = torch.nn.Parameter(torch.ones(6, 3))
            optimizer = torch.optim.SGD([{"params": [means], "name": "xyz"}], lr=1e-4)
            for step in gate.iterations(range(6000), views=names, events=range(100, 1000, 100)):
                if gate.backward(means.square().sum(), names[step % 40], step):
                    optimizer.step()
                    optimizer.zero_grad()
        reports[kind] = gate.report()
    assert reports["both"]["early_stopping"] is None
    assert reports["refinement"]["early_stopping"]["watched"]


def test_interrupted_and_resumed_leaves_out_the_same():
    with SkipGate(start_iter=START, share=0.25) as gate:
        whole = Loop().train(gate)
    for until in (whole.ran[12], whole.ran[60], whole.ran[-20]):
        with SkipGate(start_iter=START, share=0.25) as first:
            one = Loop().train(first, until)
            state = json.loads(json.dumps(first.state_dict()))
        with SkipGate(start_iter=START, share=0.25) as second:
            second.load_state_dict(state)
            other = Loop(one.ran[-1] + 1, one.means.detach(), one.optimizer.state_dict()).train(second)
        assert one.ran + other.ran == whole.ran
        assert torch.equal(other.means, whole.means)


def test_a_loop_in_parts_counts_its_iterations_and_events_through():
    loop = Loop()
    with SkipGate(start_iter=START, share=0.25) as gate:
        for loop.begin, end in ((0, 101), (101, START), (START, LAST)):
            loop.train(gate, end=end)
    assert gate.released is None and loop.saved == list(range(0, LAST, 60)) and loop.ran[-1] == LAST - 1
    grown, report = [n for n in loop.ran if n < START], gate.report()["growing"]
    assert (report["iterations_run"], report["iterations_skipped"]) == (len(grown), START - len(grown))
    assert len(grown) == pytest.approx(START / 4, abs=3)
    assert report["events_run"] == len(loop.grown)
    assert report["events_run"] + report["events_skipped"] == len(range(INTERVAL, START, INTERVAL))


def test_a_run_whose_densification_runs_whole_is_resumed():
    with (
        SkipGate(start_iter=START, share=0.25) as gate,
        pytest.warns(RuntimeWarning, match="events of iterations 0 to 399"),
    ):
        whole = Loop().train(gate, events=None)
    assert whole.ran[:START] == list(range(START)) and len(whole.ran) < START + 60
    for until in (100, whole.ran[-20]):
        with (
            SkipGate(start_iter=START, share=0.25) as first,
            pytest.warns(RuntimeWarning, match="events of iterations 0 to 399"),
        ):
            one = Loop().train(first, until, events=None)
            state = json.loads(json.dumps(first.state_dict()))
        again = pytest.warns(RuntimeWarning, match="iterations 101 to 399") if until < START else nullcontext()
        with SkipGate(start_iter=START, share=0.25) as second, again:
            second.load_state_dict(state)
            other = Loop(one.ran[-1] + 1, one.means.detach(), one.optimizer.state_dict()).train(second, events=None)
        assert one.ran + other.ran == whole.ran
        assert torch.equal(other.means, whole.means)
    with SkipGate(start_iter=START, share=0.5) as other, pytest.raises(SkipGSError, match=r"share=0\.25, not"):
        other.load_state_dict(state)


def test_off_is_bit_identical():
    plain = Loop().train(SkipGate(start_iter=0, enabled=False))
    for settings in ({"share": 1.0}, {"share": 0.2, "enabled": False}):
        with SkipGate(start_iter=START, **settings) as gate:
            loop = Loop().train(gate)
        assert loop.ran == plain.ran and torch.equal(loop.means, plain.means)


def test_events_stop_before_the_bound_on_gaussians():
    with SkipGate(start_iter=START, share=0.25, max_gaussians=6) as gate:
        assert set(Loop().train(gate).grown)
    beyond = pytest.warns(GateWarning, match="has 6 Gaussians before it grows, more than max_gaussians=5: it will not")
    with SkipGate(start_iter=START, share=0.25, max_gaussians=5) as gate, beyond:
        assert all(
            event % 60 == 0 for event in Loop().train(gate).grown
        )  # iterations that must run densify all the same
    with pytest.raises(SkipGSError, match="needs share or grow_share"):
        SkipGate(start_iter=START, max_gaussians=5)


def test_a_loop_without_known_events_grows_whole():
    with SkipGate(start_iter=10, share=0.5, pause_iters=0) as gate, pytest.warns(RuntimeWarning, match="events="):
        ran = [step for step in gate.iterations(range(40), always=()) if [gate.backward(value(), "a", step)]]
    assert ran[:10] == list(range(10)) and len(ran) < 40
    gate = SkipGate(start_iter=10, grow_share=0.5)
    with pytest.raises(SkipGSError, match="events="):
        list(gate.iterations(range(40)))


def value():
    return torch.ones((), requires_grad=True) * 1.0


def test_what_shares_its_number_with_events_keeps_it_if_it_is_rarer():
    ran, saved, logged = [], [], []
    with SkipGate(start_iter=800, share=0.05) as gate:
        for step in gate.iterations(range(900), events=range(20, 800, 20), views=VIEWS):
            gate.backward(value(), VIEWS[step % 4], step)
            ran.append(step)
            if step % 100 == 0:  # this condition holds less often than events happen
                saved.append(step)
            if step % 20 == 0:  # this one holds as often, like that of a line in a log
                logged.append(step)
    assert set(range(100, 800, 100)) <= set(ran)
    assert len(set(range(20, 800, 20)) & set(ran)) < 25


class Multiplies(Loop):
    """The same loop, in which each event adds a share of the Gaussians."""

    def __init__(self, growth):
        super().__init__()
        self.growth, self.means = growth, torch.nn.Parameter(torch.rand(100, 3))
        self.optimizer = torch.optim.Adam([{"params": [self.means], "name": "xyz"}], lr=0.1)

    def train(self, gate, until=6000, events=range(20, 3000, 20), **options):
        for step in gate.iterations(range(6000), views=VIEWS, events=events, **options):
            self.ran.append(step)
            if step >= until:
                break
            if gate.backward(self.means.square().sum(), view=VIEWS[step % 4], step=step):
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
            if step % 20 == 0 and 0 < step < 3000:
                self.grown.append(step)
                rows = min(len(self.means) * (1 + self.growth), 10_000)
                self.means = torch.nn.Parameter(torch.rand(int(rows), 3))
                self.optimizer = torch.optim.Adam([{"params": [self.means], "name": "xyz"}], lr=0.1)
        return self


def test_a_scene_that_grows_strongly_gets_more_iterations_in_both_phases():
    reports, loops = {}, {}
    for growth in (0.0, 0.01, 0.1):
        with SkipGate(start_iter=3000, share="auto") as gate:
            loops[growth] = Multiplies(growth).train(gate)
        reports[growth] = gate.report()
        assert ("because the scene grew to 100.0 times" in gate.summary()) is (growth == 0.1)
        assert "ended early" not in gate.summary()
    still, little, much = (reports[growth] for growth in (0.0, 0.01, 0.1))
    assert little["growing"]["iterations_run"] == pytest.approx(still["growing"]["iterations_run"], abs=2)
    assert still["growing"]["iterations_run"] < much["growing"]["iterations_run"] <= 0.41 * 3000  # the bound is 0.4
    assert len(loops[0.1].grown) >= len(loops[0.0].grown)
    assert (factor := for_new_gaussians(little["growing"]["times_grown"])) > 1.0
    assert little["refine_share"] == pytest.approx(factor * still["refine_share"], rel=0.02)
    assert much["refine_share"] == 0.4 < for_new_gaussians(100.0) * still["refine_share"]  # the bound
    with SkipGate(start_iter=3000, share=0.2) as gate:  # a given share is not raised
        Multiplies(0.1).train(gate)
    assert gate.report()["refine_share"] == 0.2
    assert gate.report()["growing"]["iterations_run"] == pytest.approx(600, abs=3)


def test_a_trainer_whose_positions_slow_down_too_late_gets_still_more_in_longer_phases(monkeypatch):
    monkeypatch.setattr(loop_facts, "PhasePlan", lambda *facts: PhasePlan(*facts)._replace(slow_positions=True))
    with SkipGate(start_iter=3000, share="auto") as gate:
        Multiplies(0.1).train(gate)
    most = 0.4 * (3000 / 1500) ** 0.35
    assert gate.report()["refine_share"] == pytest.approx(most)
    assert 0.41 * 3000 < gate.report()["growing"]["iterations_run"] <= (most + 0.01) * 3000


def test_more_iterations_run_after_an_event_that_adds_more_also_where_the_share_is_large():
    run = {}
    for growth in (0.01, 0.03):
        with SkipGate(start_iter=3000, share="auto") as gate:
            Multiplies(growth).train(gate)
        run[growth] = gate.report()["growing"]["iterations_run"]
    assert run[0.01] == pytest.approx(765, abs=3)  # 600 * 2 ** 0.35
    assert run[0.03] > 1.2 * run[0.01]


@pytest.mark.parametrize(
    ("reset", "share", "least", "most"),
    [(2500, "auto", 1, 1), (2000, "auto", 0.48, 0.55), (1000, "auto", 0.2, 0.3), (2500, 0.25, 0.2, 0.3)],
)
def test_opacities_recover_from_a_late_reset_while_the_scene_grows(reset, share, least, most):
    with SkipGate(start_iter=3000, share=share) as gate:
        loop = Multiplies(0.0).train(gate, resets=[reset])
    ran = sum(reset < step < 3000 for step in loop.ran) / (2999 - reset)
    assert least <= ran <= most
    before = sum(20 < step < reset for step in loop.ran) / (reset - 21)
    assert before == pytest.approx(765 / 3000 if share == "auto" else 0.25, abs=0.02)


def test_what_follows_the_last_event_does_not_count_for_the_recovery():
    with SkipGate(start_iter=3000, share="auto") as gate:
        loop = Multiplies(0.0).train(gate, events=range(20, 2500, 20), resets=[2300])
    assert {*range(2300, 2500)} <= set(loop.ran)
    assert sum(2500 <= step < 3000 for step in loop.ran) < 0.4 * 500


def test_after_the_recovery_the_share_runs_as_before_it(monkeypatch):
    monkeypatch.setattr(Visibility, "visible", None)  # as with features that a network decodes
    with SkipGate(start_iter=3000, share="auto") as gate:
        loop = Multiplies(0.0).train(gate, events=range(20, 2500, 20), resets=[2300])
    for numbers in (range(100, 2300), range(2500, 2600), range(2600, 3000)):
        ran = len(set(numbers) & set(loop.ran)) / len(numbers)
        assert ran == pytest.approx(gate.report()["growing"]["share"], abs=0.03)


def test_steps_conserve_the_path_in_any_schedule_if_opacities_are_never_reset():
    assert growing_factor(25_000, 0.2, 1 / 3, by_budget=True, resets=False) == pytest.approx(5.0)
    assert growing_factor(25_000, 0.1, 0.96, by_budget=True, resets=False) == 8.0  # the longest that pay
    assert growing_factor(25_000, 0.9, 1 / 3, by_budget=True, resets=False) == pytest.approx(1 / 0.9)
    assert growing_factor(25_000, 0.1, 0.96, resets=False) == 5.0  # there, the number of Gaussians rises with them


@pytest.mark.parametrize("resets, expected", [((), (5.0, 1.0)), ((390,), (6.0, 2.0)), (None, (4.0, 2.0))])
def test_opacities_keep_their_rate_where_they_need_not_recover_from_resets(resets, expected):
    loop = Opaque()
    with SkipGate(start_iter=START, share=0.25) as gate:
        loop.train(gate, resets=resets)
    assert loop.between(200, 390) == {expected}
    growing = gate.report()["growing"]
    assert growing["rate_factor"] == (5.0 if resets == () else 3.0)
    assert growing["opacity_rate_factor"] == expected[1]


def test_resets_run_and_need_events():
    gate = SkipGate(start_iter=START, share=0.25)
    with pytest.raises(SkipGSError, match="resets= is for loops whose densification events are known: give events="):
        gate.iterations(range(LAST), views=VIEWS, resets=[])
    with gate:
        assert {151, 307} <= set(Loop().train(gate, resets=[151, 307]).ran)


def test_a_run_that_ends_while_the_scene_grows_says_so():
    with SkipGate(start_iter=3000, share="auto") as gate:
        Multiplies(0.1).train(gate, until=500)
    assert "conditions of the loop need iterations, or because the run ended early" in gate.summary()


@pytest.mark.parametrize("compensate", [True, False])
def test_the_length_of_steps_is_told_only_where_they_are_longer(compensate):
    with SkipGate(start_iter=START, share=0.25, compensate=compensate) as gate:
        Loop().train(gate)
    assert ("each view shows 100 % of the Gaussians" in gate.summary()) == compensate
