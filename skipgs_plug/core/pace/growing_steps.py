"""Longer steps in the growing phase, in place of the iterations that are left out."""

from __future__ import annotations

from skipgs_plug.core.pace.growing_plan import GrowingPlan
from skipgs_plug.core.pace.needs import (
    HIGHEST_OPACITY_RATE,
    LONGEST_STEPS_OF_POSITIONS,
    LONGEST_STEPS_OF_POSITIONS_THAT_STAY,
    LONGEST_STEPS_OF_SCALES,
    SELDOM_SHOWN,
    for_new_gaussians,
    geometry_part,
    growing_factor,
    opacity_factor,
)
from skipgs_plug.core.pace.parts import GEOMETRY, GrowingParts


def longer_steps(
    plan: GrowingPlan, share: float, visible: float, times_grown: float | None, fading: bool
) -> tuple[float, GrowingParts]:
    """Return the factor on learning rates, and how kinds of parameters share in it.

    Args:
        plan: Schedule of the phase.
        share: Share of the iterations that run at present, in (0, 1].
        visible: Share of the Gaussians that a view shows.
        times_grown: Present number of Gaussians, as a multiple of those at the first event; None if unknown.
        fading: Whether the points that the scene began with faded.
    """
    events = plan.events
    factor = growing_factor(
        plan.length, share, visible, events.all_run, times_grown, plan.resets, refined=not plan.unrefined
    )
    opacities = opacity_factor(share) if fading or plan.opacities_recover else 1.0
    if fading and plan.reset is None:
        # A reset takes random points away. Without one, long steps would make them large, and they would stay.
        return factor, GrowingParts(opacities, 1.0, 0.0, events.clears_moments)
    scales = GEOMETRY if plan.reset is None else geometry_part(factor, LONGEST_STEPS_OF_SCALES)
    far = (plan.reset is not None and not fading) or not events.resets
    if plan.unrefined and for_new_gaussians(times_grown) > 1.0:  # its growth does not slow down otherwise
        far = False
    positions = geometry_part(factor, LONGEST_STEPS_OF_POSITIONS if far else LONGEST_STEPS_OF_POSITIONS_THAT_STAY)
    if plan.unrefined and not fading and not plan.steps_after:
        return factor, GrowingParts(opacities, positions, scales, True, HIGHEST_OPACITY_RATE)
    remember = bool(plan.random_points) and not events.resets and visible < SELDOM_SHOWN
    # MCMC has a price on sizes. With a bound besides, it ends 0.2 dB lower on fern.
    return factor, GrowingParts(
        opacities, positions, scales, events.clears_moments, all_remember=remember, bounded=not events.all_run
    )
