"""Scaffold-GS: networks are held still with the anchors, and statistics are read before the gate begins."""

import pytest
import torch
from cases import SkipAlways
from lookalikes import scaffold_gs
from lookalikes.splats import new_log

from skipgs_plug import SkipGate, SkipGSError


def network(last=scaffold_gs.LAST, **settings):
    """Parameters of the network after a run, gated if there are settings."""
    new_log()
    if not settings:
        captured, _ = scaffold_gs.train(last=last)
    else:
        with SkipGate(scaffold_gs, **settings):
            captured, _ = scaffold_gs.train(last=last)
    return torch.cat([p.detach().flatten() for p in captured["mlp_color"].parameters()])


def test_network_is_held_still_where_all_is_skipped():
    before = network(last=scaffold_gs.START - 1)
    assert torch.equal(network(policy=SkipAlways()), before)
    assert not torch.equal(network(), before)


def test_start_before_update_until_is_refused():
    with pytest.raises(SkipGSError, match="start_iter=19 is too early: up to iteration 20"):
        network(start_iter=19)
