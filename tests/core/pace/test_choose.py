"""Settings of the paper's gate beside a share."""

import pytest

from skipgs_plug import SkipGate


@pytest.mark.parametrize("share", [{"share": 0.5}, {"refine_share": "auto"}])
def test_settings_that_have_no_effect_beside_a_share_are_named(share):
    with pytest.warns(RuntimeWarning, match=r"Leave out threshold, warmup: only the paper's gate uses"):
        SkipGate(start_iter=40, threshold=0.1, warmup=0, ema_decay=0.9, **share)


def test_the_papers_gate_and_defaults_beside_a_share_get_no_warning():
    SkipGate(start_iter=40, threshold=0.1, warmup=0, min_bwd_ratio=0.0)
    SkipGate(start_iter=40, share="auto", warmup=500, min_bwd_ratio="auto")
