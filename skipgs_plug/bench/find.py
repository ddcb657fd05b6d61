"""Find policies of both kinds of bench by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from skipgs_plug.bench.policies import POLICIES, BenchPolicy, refinement_policy
from skipgs_plug.bench.whole_policies import WHOLE_POLICIES, whole_policy
from skipgs_plug.trainer.errors import InputError


def find_policy(name: str, whole: bool) -> BenchPolicy | None:
    """Return the policy with this name for whole runs or for refinement; None if it does not exist."""
    return whole_policy(name) if whole else refinement_policy(name)


def known_policies(whole: bool) -> Mapping[str, BenchPolicy]:
    """Return the policies that run by default."""
    return WHOLE_POLICIES if whole else POLICIES


def require_policies(names: Sequence[str], whole: bool) -> None:
    """Raise InputError if no policy is given, or if one is unknown, given twice, or lacks a policy that it needs."""
    known = ", ".join(known_policies(whole))
    if not names:
        raise InputError(f"--policies is empty; give some of {known}, or leave it out for all.")
    for name in names:
        spec = find_policy(name, whole)
        if spec is None and not whole and whole_policy(name) is not None:
            raise InputError(f"Policy {name!r} is one of whole runs; give --whole, too.")
        if spec is None:
            raise InputError(f"There is no policy {name!r}; the policies are {known}.")
        if names.count(name) > 1:
            raise InputError(f"Policy {name!r} is given twice.")
        missing = [other for other in spec.needs if other not in names]
        if missing:
            raise InputError(f"Policy {name!r} copies rate or time of {missing[0]!r}; add {missing[0]} to --policies.")
