"""Shares for "auto": how many iterations a phase needs, by what is known before it or measured in it."""

from __future__ import annotations

import math

# Growing (before densification ends).
LEAST_GROWING_SHARE = 0.12  # a tenth of 15,000 iterations is the least that held on bonsai and the room
LEAST_GROWING_STEPS = 1200  # iterations at the trainer's own steps: 750 lost 0.3 dB on Lego and 0.7 dB on bonsai
LEAST_GROWING_STEPS_LONGER = 600  # iterations with longer steps: 450 held on fern, 700 on bonsai
GROWING_VISITS = 5.0  # of each view, at the trainer's own steps: 4.7 lost 0.5 dB on bonsai 399x266
GROWING_VISITS_LONGER = 3.5  # of each view, with longer steps: 2.7 lost 0.002 SSIM on bonsai in 7,000 iterations
NEARLY_ALL = 0.8  # share of the Gaussians that a view shows, from which growth is limited by the number of events
# Iterations per event where each event adds a share of the Gaussians or a part of a budget: what an event adds must be
# fitted before the next one copies it. 3DGS-MCMC from 1,500 points to 12,000 on fern loses 0.8 dB with 10 iterations
# per event and nothing with 14. `LEAST_GROWING_STEPS` are enough for any number of events.
STEPS_PER_EVENT = 14
# Iterations of growth that need no longer steps. With fewer, steps may be longer by the square of the lack: longer
# schedules reset opacities more often than the few iterations between two resets can bear at long steps. Four times the
# rate in 1,500 iterations cost bonsai 0.6 dB; in 700 to 900 iterations it won 0.5 dB and more.
ENOUGH_STEPS = 2100
LONGEST_STEPS = 4.0  # greatest factor while the scene grows; 8 is no better than 4

# Refining (after it).
LEAST_SHARE = 0.2
LEAST_STEPS = 400  # fewer have no room to shrink in: 300 after a thinned growth cost fern 0.1 to 0.15 dB
# Share at one visit of each view in all of refinement; it falls with the fourth root of the visits. On bonsai nothing
# is lost from 0.35, 0.3 and 0.25 on, at 2, 6 and 12 visits.
RARE_SHARE = 0.46
# The same where iterations were left out before refinement, too: 0.25 at 14 visits ended bonsai 0.002 SSIM too low.
RARE_SHARE_AFTER_FEW = 0.56


def refining_share(iterations: int, epoch: int, grown_by_few: bool = False) -> float:
    """Share of the refinement iterations that may be needed, known beforehand.

    A fifth, or more where views are many for so few iterations or these are few by themselves; all where not every view
    comes up once.

    Args:
        iterations: Refinement iterations of the schedule.
        epoch: Number of iterations in which every view comes up once.
        grown_by_few: Whether iterations were left out before refinement, too.
    """
    if iterations < epoch:
        return 1.0
    rare = RARE_SHARE_AFTER_FEW if grown_by_few else RARE_SHARE
    return min(1.0, max(LEAST_SHARE, LEAST_STEPS / iterations, rare * (epoch / iterations) ** 0.25))


def growing_share(iterations: int, epoch: int, longer: bool, events: int = 0) -> float:
    """Share of the iterations before the end of densification that are needed.

    Args:
        iterations: Iterations of the schedule until densification ends.
        epoch: Iterations in which each training view comes up once.
        longer: Whether longer steps may replace iterations; see `growing_factor`.
        events: Densification events, if all of them run; 0 where events are left out.
    """
    if iterations < 1:
        return 1.0
    steps = LEAST_GROWING_STEPS_LONGER if longer else LEAST_GROWING_STEPS
    visits = GROWING_VISITS_LONGER if longer else GROWING_VISITS
    steps = max(steps, min(STEPS_PER_EVENT * events, LEAST_GROWING_STEPS))
    needed = max(steps, visits * epoch)
    return min(1.0, max(LEAST_GROWING_SHARE, needed / iterations))


def growing_factor(iterations: int, share: float, visible: float | None) -> float:
    """Factor on learning rates while the scene grows.

    Parameters do not travel far enough in few iterations. Longer steps make up for that, as far as they conserve the
    path of the iterations left out: see `path_factor`, whose mean this is at most.

    Args:
        iterations: Iterations of the schedule until densification ends.
        share: Share of them that runs, in (0, 1].
        visible: Share of the Gaussians that a view shows; None before it is measured.
    """
    if visible is None or share >= 1.0:
        return 1.0
    conserved = math.sqrt(3.0 * visible) / share
    return max(1.0, min(LONGEST_STEPS, conserved, (ENOUGH_STEPS / math.ceil(share * iterations)) ** 2))
