from __future__ import annotations

import pytest

from skipgs_plug.bench.policies import POLICIES, check_policies, running_order
from skipgs_plug.trainer import InputError


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


def test_order_rotates_and_controls_follow_what_they_copy():
    firsts, last = set(), set()
    for position in range(12):
        order = [spec.name for spec in running_order(tuple(POLICIES), position)]
        assert sorted(order) == sorted(POLICIES)
        for name in order:
            assert all(order.index(other) < order.index(name) for other in POLICIES[name].needs)
        firsts.add(order[0])
        last.add(order[-1])
    assert firsts == {"ungated", "gate", "gate-no-floor", "gate-accumulate"}
    assert last == {"random", "periodic", "shortened"}
