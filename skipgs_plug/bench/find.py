"""Find policies of both kinds of bench by name."""

from __future__ import annotations

from collections.abc import Mapping

from skipgs_plug.bench.policies import POLICIES, BenchPolicy, refinement_policy
from skipgs_plug.bench.whole_policies import WHOLE_POLICIES, whole_policy


def find_policy(name: str, whole: bool) -> BenchPolicy | None:
    """Return the policy with this name for whole runs or for refinement; None if it does not exist."""
    return whole_policy(name) if whole else refinement_policy(name)


def known_policies(whole: bool) -> Mapping[str, BenchPolicy]:
    """Return the policies that run by default."""
    return WHOLE_POLICIES if whole else POLICIES
