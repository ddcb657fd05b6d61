from __future__ import annotations

import pytest

from skipgs_plug.bench.find import find_policy, require_policies
from skipgs_plug.bench.policies import POLICIES, rounds
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.trainer import InputError, TrainConfig, Trainer


@pytest.mark.parametrize(
    ("names", "named"),
    [
        (("own", "gatee"), "'gatee'"),
        (("own", "share=auto"), "give --whole"),
        (("own", "share=0.4"), "give --whole"),
        (("own", "share=4"), "no policy 'share=4'"),
        (("own", "own"), "given twice"),
        (("own", "random"), "add gate"),
        (("gate", "shortened"), "add own"),
    ],
)
def test_unusable_policies_are_refused_by_name(names, named):
    with pytest.raises(InputError, match=named):
        require_policies(names, whole=False)


def test_policies_run_in_turns_with_those_that_copy_from_the_same_rounds():
    firsts = set()
    names = ("own", "gate", "gate,min_bwd_ratio=0", "refine_share=auto", "random", "periodic", "shortened")
    for position in range(12):
        free, controls = (
            [spec.name for spec in group] for group in rounds([POLICIES[name] for name in names], position)
        )
        assert sorted([*free, *controls]) == sorted(names)
        assert set(free) == {"own", "gate", "gate,min_bwd_ratio=0", "refine_share=auto"}
        firsts.add((free[0], controls[0]))
    assert len(firsts) == 12  # every order of four and three


def test_shortened_takes_the_time_of_the_gate(scene):
    trainer = Trainer(TrainConfig(max_steps=2000), scene)

    def shortened(gate_seconds: float) -> int:
        earlier = {name: RunRecord(0, name, t_post=t) for name, t in {"gate": gate_seconds, "own": 100.0}.items()}
        return POLICIES["shortened"].iterations(trainer, earlier)

    assert shortened(60.0) == 600
    assert shortened(110.0) == 1000
    assert shortened(0.001) == 1


@pytest.mark.parametrize(
    ("iterations", "visible", "peak"),
    [
        *((30_000, None, 5.0), (30_000, 1 / 3, 5.0), (30_000, 0.75, 7.5)),
        *((2_000, None, 5.0), (2_000, 1 / 3, 8.0), (2_000, 0.75, 12.0)),  # 400 steps of refinement are few
    ],
)
def test_own_compensate_has_the_factors_of_refine_share(scene, iterations, visible, peak):
    trainer = Trainer(TrainConfig(max_steps=iterations), scene)
    gate = POLICIES["own,compensate"].gate(
        trainer, {"refine_share=0.4": RunRecord(0, "refine_share=0.4", gaussians_shown=visible)}
    )
    with gate:
        assert gate.config.rate_peak == pytest.approx(peak)
        assert gate.config.refine_share == 1.0


@pytest.mark.parametrize(
    ("name", "whole", "found"),
    [
        ("refine_share=0.3", False, True),
        ("refine_share=0.3", True, True),
        ("share=0.25", True, True),
        ("share=.5", True, True),
        ("share=0.25", False, False),
        ("share=1.5", True, False),
        ("share=0", True, False),
        ("share=nan", True, False),
        ("share", True, False),
        ("own", False, True),
    ],
)
def test_policies_are_called_as_the_settings_of_a_gate(name, whole, found):
    spec = find_policy(name, whole)
    assert (spec is not None) == found
    assert spec is None or spec.name == name


def test_the_gate_of_a_share_in_a_name_has_it(scene):
    trainer = Trainer(TrainConfig(max_steps=2000), scene)
    with find_policy("refine_share=0.3", whole=False).gate(trainer, {}) as gate:
        assert gate.config.refine_share == 0.3
