"""Shares for "auto": how many iterations a phase needs, by what is known before it or measured in it."""

from __future__ import annotations

import math

# Growing (before densification ends).
LEAST_GROWING_SHARE = 0.1  # a tenth of 15,000 iterations is the least that held on bonsai and the room
LEAST_GROWING_STEPS = 1200  # iterations: 750 lost 0.3 dB on Lego and 0.7 dB on bonsai
LEAST_GROWING_STEPS_FULL_VIEWS = 700  # iterations, with full views and longer steps: 600 lost 0.14 dB on fern
GROWING_VISITS = 5.0  # of each view: 4.7 lost 0.5 dB on bonsai 399x266
NEARLY_ALL = 0.8  # share of the Gaussians that a view shows, from which longer steps replace iterations
# Iterations of growth whose path longer steps make up for. The number of Gaussians follows the length of steps: a tenth
# of Lego's growth ends with 73 % of them at the trainer's own steps, with 99 % at 1.4 times, with 135 % at twice.
FULL_PATH = 2100

# Refining (after it).
LEAST_SHARE = 0.2
LEAST_STEPS = 400  # fewer have no room to shrink in: 300 after a thinned growth cost fern 0.1 to 0.15 dB
# Share at one visit of each view in all of refinement; it falls with the fourth root of the visits. On bonsai nothing
# is lost from 0.35, 0.3 and 0.25 on, at 2, 6 and 12 visits.
RARE_SHARE = 0.46


def refining_share(iterations: int, epoch: int) -> float:
    """Share of the refinement iterations that may be needed, known beforehand.

    A fifth, or more where views are many for so few iterations or these are few by themselves; all where not every view
    comes up once.

    Args:
        iterations: Refinement iterations of the schedule.
        epoch: Number of iterations in which every view comes up once.
    """
    if iterations < epoch:
        return 1.0
    return min(1.0, max(LEAST_SHARE, LEAST_STEPS / iterations, RARE_SHARE * (epoch / iterations) ** 0.25))


def growing_share(iterations: int, epoch: int, visible: float | None) -> float:
    """Share of the iterations before the end of densification that are needed.

    Args:
        iterations: Iterations of the schedule until densification ends.
        epoch: Number of iterations in which every view comes up once.
        visible: Share of the Gaussians that a view shows; None before it is measured.
    """
    if iterations < 1:
        return 1.0
    full_views = visible is not None and visible >= NEARLY_ALL
    steps = LEAST_GROWING_STEPS_FULL_VIEWS if full_views else LEAST_GROWING_STEPS
    return min(1.0, max(LEAST_GROWING_SHARE, steps / iterations, GROWING_VISITS * epoch / iterations))


def growing_factor(iterations: int, share: float, visible: float | None) -> float:
    """Factor on learning rates while the scene grows.

    On a short schedule parameters do not travel far enough in fewer iterations. Where a view shows nearly all
    Gaussians, longer steps make up for that; elsewhere they harm, as in refinement.

    Args:
        iterations: As for `growing_share`.
        share: Share of them that runs, in (0, 1].
        visible: As for `growing_share`.
    """
    if visible is None or visible < NEARLY_ALL:
        return 1.0
    return min(1.0 / share, max(1.0, FULL_PATH / math.ceil(share * iterations)))
