from __future__ import annotations

import pytest

from skipgs_plug.bench.policies import POLICIES, check_policies, rounds
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.trainer import InputError, TrainConfig, Trainer


@pytest.mark.parametrize(
    ("names", "named"),
    [
        (("ungated", "gatee"), "'gatee'"),
        (("ungated", "ungated"), "given twice"),
        (("ungated", "random"), "add gate"),
        (("gate", "shortened"), "add ungated"),
    ],
)
def test_unusable_policies_are_refused_by_name(names, named):
    with pytest.raises(InputError, match=named):
        check_policies(names)


def test_policies_run_in_turns_with_those_that_copy_from_the_same_rounds():
    firsts = set()
    names = ("ungated", "gate", "gate-no-floor", "gate-accumulate", "random", "periodic", "shortened")
    for position in range(12):
        free, controls = ([spec.name for spec in group] for group in rounds(names, position))
        assert sorted([*free, *controls]) == sorted(names)
        assert set(free) == {"ungated", "gate", "gate-no-floor", "gate-accumulate"}
        firsts.add((free[0], controls[0]))
    assert len(firsts) == 12  # every order of four and three


def test_shortened_takes_the_time_of_the_gate(scene):
    trainer = Trainer(TrainConfig(max_steps=2000), scene)

    def shortened(gate_seconds: float) -> int:
        earlier = {name: RunRecord(0, name, t_post=t) for name, t in {"gate": gate_seconds, "ungated": 100.0}.items()}
        return POLICIES["shortened"].iterations(trainer, earlier)

    assert shortened(60.0) == 600
    assert shortened(110.0) == 1000
    assert shortened(0.001) == 1


@pytest.mark.parametrize(("shown", "peak"), [(None, 5.0), (1 / 3, 5.0), (0.75, 7.5)])
def test_ungated_larger_has_the_factors_of_thinned(scene, shown, peak):
    trainer = Trainer(TrainConfig(max_steps=2000), scene)
    gate = POLICIES["ungated-larger"].gate(trainer, {"thinned": RunRecord(0, "thinned", gaussians_shown=shown)})
    with gate:
        assert gate.config.rate_peak == pytest.approx(peak)
        assert gate.config.refine_share == 1.0
