"""Settings refuse invalid values, and name the setting."""

from __future__ import annotations

import dataclasses

import pytest

from skipgs_plug import SkipConfig, SkipGate, SkipGSError
from skipgs_plug.core.policy import SkipPolicy


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("start_iter", -1),
        ("start_iter", 1.5),
        ("start_iter", True),
        ("warmup", -1),
        ("warmup", "many"),
        ("pause_iters", -5),
        ("threshold", -1.0),
        ("threshold", float("nan")),
        ("ema_decay", 1.0),
        ("ema_decay", -0.1),
        ("min_bwd_ratio", 1.1),
        ("min_bwd_ratio", "half"),
        ("min_bwd_ratio", float("nan")),
        ("on_nonfinite", "ignore"),
        ("share", 0.0),
        ("grow_share", 1.5),
        ("max_gaussians", -1),
        ("always", (5, -5)),
    ],
)
def test_bad_values_name_their_field(field: str, value) -> None:
    with pytest.raises(SkipGSError, match=field):
        SkipConfig(**{field: value})


def test_is_frozen_and_plain() -> None:
    config = SkipConfig(start_iter=5)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.warmup = 3  # type: ignore[misc]
    assert config.as_dict()["start_iter"] == 5
    assert SkipConfig(**config.as_dict()) == config


def test_gate_names_unknown_settings() -> None:
    with pytest.raises(SkipGSError, match="warmups"):
        SkipGate(start_iter=0, warmups=3)
    with pytest.raises(SkipGSError, match="not both"):
        SkipGate(config=SkipConfig(start_iter=0), warmup=3)
    with pytest.raises(SkipGSError, match="start_iter"):
        SkipGate()
    with pytest.raises(SkipGSError, match="str is not a policy; derive it from"):
        SkipGate(start_iter=0, policy="random")  # type: ignore[arg-type]


def test_a_policy_of_its_own_checks_its_settings_too() -> None:
    for settings in ({"start_iter": -1}, {"start_iter": 0, "ema_decay": 1.0}, {"start_iter": None}):
        with pytest.raises(SkipGSError, match=list(settings)[-1]):
            SkipPolicy(**settings)
