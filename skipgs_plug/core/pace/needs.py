"""Shares for "auto": the number of iterations that a phase needs."""

from __future__ import annotations

import math

from skipgs_plug.core.pace.parts import GEOMETRY

# Growing (before densification ends).
# Least share of the iterations that run. A tenth of 15,000 iterations is the least that lost nothing on bonsai and on
# room. With 8.5 % bonsai ends with three quarters of its Gaussians.
LEAST_GROWING_SHARE = 0.1
# Least number of iterations at the trainer's own rates. 750 iterations lost 0.3 dB on Lego and 0.7 dB on bonsai.
LEAST_GROWING_STEPS = 1200
# Least number of iterations with longer steps, in a schedule that grows for `SHORT_PHASE` iterations. 450 lost nothing
# on fern, 700 lost nothing on bonsai. Longer schedules need more, by the power `LONGER_PHASE` of their length: 600 lost
# 0.17 dB of 3,000 on 46 views of bonsai, and 0.26 dB of 6,000 on a ray-traced scene. 765 and 950 lost nothing.
LEAST_GROWING_STEPS_LONGER = 600
SHORT_PHASE = 1500
LONGER_PHASE = 0.35
# Least number of iterations if the points that a scene begins with fade, as random ones do. Those that have not faded
# stay as haze in front of views that were not trained on. Lego from 100,000 random points, 7,000 iterations, ends at
# 30.9 dB in its own run. With 807 iterations until densification ends, it has 20 to 25 dB, with 1,400 it has 28.7 dB,
# and with 1,750 it has 31.1 dB.
GROWING_STEPS_FROM_RANDOM = 1750
# Least number of iterations in which a Gaussian is shown then. Bonsai from 100,000 random points, of which a view shows
# 6 %, ends 1.26 dB below its own run of 30,000 iterations with 3,060 iterations until densification ends, 0.49 dB with
# 6,000, and level with 9,000.
GROWING_SIGHTS_FROM_RANDOM = 540
# The same where points need not fade, because MCMC moves them. Bonsai from 30,000 random points, of which a view shows
# a tenth, ends level with its own run of 7,000 iterations (-.0126 SSIM) with 22 % of 5,832 iterations, and 0.9 dB above
# it (+.0133) with half of them.
GROWING_SIGHTS_IF_MOVED = 270
# Largest share that a view shows of random points with which MCMC's parameters keep the trainer's beta2 while the scene
# grows. Its regularisers of opacities and scales have a gradient also for Gaussians that no view shows. Where Adam soon
# forgets the gradients of views, it alone makes steps of full length, and Gaussians fade and shrink until the next view
# shows them. Half of the iterations of bonsai from random points end at 26.52 dB with the trainer's beta2, and at 23.48
# dB with a lower one (own run 25.60). Lego, of whose points a view shows most, ends at 30.41 and 31.47 dB.
SELDOM_SHOWN = 1 / 3
# Least number of visits of each view, also with longer steps: 3.5 visits lost 0.003 SSIM on bonsai at 399x266 pixels in
# 7,000 iterations, and 5 ended 0.002 above the trainer's own run. At its own rates 4.7 visits lost 0.5 dB there.
GROWING_VISITS = 5.0
# The same in a schedule without opacity resets, where steps are longer. With 3.6 visits, bonsai at 399x266 pixels in
# 7,000 iterations ends 0.08 dB above its own run and 0.0006 SSIM below it, with 5 it ends 0.28 dB and 0.003 above.
GROWING_VISITS_WITHOUT_RESETS = 4.0
# Iterations per event, if each event adds a share of the Gaussians or a part of a budget: the new Gaussians must be
# fitted before the following event copies them. 3DGS-MCMC that grows from 1,500 points to 12,000 on fern loses 0.8 dB
# with 10 iterations per event and nothing with 14. `LEAST_GROWING_STEPS` are enough for any number of events.
STEPS_PER_EVENT = 14
# Largest growth per event, as a share of the Gaussians, at which the share of the phase is enough. More iterations run
# after events that add more, so that new Gaussians are fitted and the following events come sooner. Bonsai that grows
# from 3,000 points to 97,000 in 30,000 iterations lost 2.5 dB with a tenth of them, and loses nothing with this number.
# With 0.03 it had 89 % of its Gaussians and 0.005 less SSIM. Of 7,000 iterations on plant, whose events add 4 %, 812 of
# 3,500 ended 0.48 dB (.0135 SSIM) below the own run with 72 % of its Gaussians, and 1,239 ended 0.23 dB (.0013) above
# it with 90 %. Events after fewer iterations bring back the Gaussians, but not the quality.
GROWTH_PER_EVENT = 0.015
# How much a share is raised for Gaussians that are new: by a part of the logarithm of their number, as a multiple of
# the number at the beginning. Up to e times as many need nothing more.
NEW_GAUSSIANS = 1 / 3
# Largest share of a phase's iterations that run because of new Gaussians, or of many views in refinement. Without a
# bound, schedules of 3,000 run half of their iterations or more. On fern with 4,000 to 74,000 Gaussians, 1,845 of 3,000
# iterations end 0.10 dB higher than 1,201 (seed 0), which end level with the trainer's own run (three seeds). Some
# trainers may run more, see `most_raised`.
MOST_RAISED_SHARE = 0.4
# Least number of iterations from the last opacity reset to the last densification event, if no more than `LATE_RESET`
# iterations of the schedule lie between them. Refinement would begin among opacities of 0.01 otherwise. Inria's script
# with 7,000 iterations resets 500 before it ends to grow. With 115 of them, three scenes end 0.13 to 0.35 dB (.0016 to
# .0067 SSIM) lower than with all of them and as many events.
STEPS_AFTER_RESET = 500
LATE_RESET = 1000
# Number of iterations of growth from which steps need not be longer. With fewer iterations, the factor grows with the
# square of the lack. Longer schedules reset opacities more often, and the few iterations between two resets do not
# tolerate long steps: four times the rate in 1,500 iterations cost bonsai 0.6 dB, but gained 0.5 dB and more in 700 to
# 900 iterations.
ENOUGH_STEPS = 2100
# Largest factor on `ENOUGH_STEPS` in a scene that grows to many times its Gaussians. New Gaussians have a long way to
# go in few iterations. On bonsai that grows from 8,000 to 200,000 Gaussians, 6,001 of 30,000 iterations end at 30.52 dB
# without a factor, at 30.83 dB with 2 and at 30.64 dB with 3; from 3,000 points at 29.11, 29.53 and 29.43 dB.
MOST_FOR_NEW_GAUSSIANS = 2.0
# Largest factor on rates while the scene grows. On two seeds of 6,000 iterations Lego ends with 108 and 118 % of its
# Gaussians with a factor of 4, with 99 and 105 % with 3, and 0.1 to 0.25 dB lower with 2.5.
LONGEST_STEPS = 3.0
# Largest factor on rates where a budget or a share per event sets the number of Gaussians, which longer steps do not
# raise. With 3, the script of 3DGS-MCMC, which had this bound then, ended at 29.8 and 30.3 dB on fern, with 4 at 30.5
# (own run 30.6).
LONGEST_STEPS_BY_BUDGET = 4.0
# Largest factor on rates in any schedule without opacity resets. With 8, a ray-traced scene ends with 117 % of its
# Gaussians, with 5 it ends with 93 %. With 3, Lego and bonsai end 0.1 to 0.2 dB lower.
LONGEST_STEPS_WITHOUT_RESETS = 5.0
# The same where a budget or a share per event sets the number of Gaussians. With 30,000 iterations, 3DGS-MCMC on Lego
# ends 0.02 dB below its own run with 8, 0.2 dB with 4 and 0.3 dB with 16.
LONGEST_STEPS_BY_BUDGET_WITHOUT_RESETS = 8.0
# Factor on rates, also of scales, if a run with opacity resets ends before densification does, or soon after: then
# nothing else makes up for the path that is missing. Inria's script cut at 7,000 iterations ends on bonsai 0.5 dB below
# its own run with 2.7 for most parameters and 5.4 for scales, and level with it with 4. With 6, SSIM is .004 lower.
LONGEST_STEPS_WITHOUT_REFINEMENT = 4.0
# Largest learning rate of opacities in a run that ends before densification does, where they keep the trainer's beta2.
# They have a tenth of the iterations to recover from their last reset. The package's trainer ends 0.3 dB lower on
# bonsai with a rate of 0.12, and with beta2 lowered. Inria's, of 0.025, ends 0.1 dB lower than with this one.
HIGHEST_OPACITY_RATE = 0.05
# Largest factor on the rate of positions, which take twice the common factor elsewhere. With 8 instead of 4, and the
# bound on scales below, 12,000 iterations end 0.24 dB higher on bonsai, 0.42 dB on fern that grows from 4,000 points,
# and 0.05 dB on the ray-traced scene. Runs without enough refinement gain 0.1 to 0.5 dB (two scenes). 3DGS-MCMC on
# bonsai, 7,000 iterations, gains 0.2 and 0.7 dB (two seeds).
LONGEST_STEPS_OF_POSITIONS = 8.0
# The same where no reset takes away what is out of place, and for random points. Without resets the ray-traced scene
# has 112 instead of 100 % of its Gaussians with 8 in 7,000 iterations, and fern ends 0.16 dB lower with 3,000. In a
# run without refinement, Lego from random points has 114 instead of 86 %. Where such a run has grown to more than e
# times its Gaussians, Inria's script cut at 7,000 iterations has 138 instead of 109 % on a fox's head.
LONGEST_STEPS_OF_POSITIONS_THAT_STAY = 4.0
# Largest factor on the rate of scales in schedules with opacity resets. They take twice the common factor elsewhere.
# Without resets, fern ends 0.3 dB lower with this bound.
LONGEST_STEPS_OF_SCALES = 4.0

# Length of the last part of a run that ends before densification does, or soon after, as a part of the run. Steps do
# not shrink there as in refinement, so all iterations run, at the trainer's own rates but those of higher bands.
LAST_PART = 0.1
# Most iterations of that part. Opacities recover from a reset in so many iterations.
MOST_LAST = 1000
# Factor on rates in that part. The colours' higher bands take four times as much, and all other parameters keep the
# trainer's rates. Inria's script gains 0.3 dB on bonsai at 200 and at 399 pixels, and 0.15 dB on fern. Positions and
# scales at twice their rates lose 0.2 dB.
LAST_FACTOR = 2.0

# Refining (after densification ends).
# Largest rate of positions, as a multiple of their first one, if each view comes up `AVERAGING_VISITS` times at most.
# Most trainers have lowered the rate to a tenth by then, so that steps are 2 to 2.7 times as long as the first ones.
# Inria's script lowers it by 30,000 iterations, however many it runs. With 7,000, positions took 10 to 15 times their
# first rate, which cost Lego 2.4 dB, and bonsai at 399 pixels 0.5 dB. On fern each view comes up 32 to 44 times, and 11
# times the first rate ends 0.25 dB higher than twice. So the bound goes with the visits, over which the noise of single
# views averages out.
LONGEST_POSITIONS = 2.0
AVERAGING_VISITS = 10.0
# Length of the path of opacities (sum of their rates) after their last reset. They begin at 0.01, however long their
# steps are. Inria's script on bonsai at 798x531 pixels, 7,000 iterations, reset them at iteration 3,000: with a path of
# 27 it ended with a mean opacity of 0.12 instead of 0.43, and 1.5 dB below its own run. A path of 60 lost nothing. On
# plant, a path of 71 ended with 0.15 instead of 0.35, and one of 100 with 0.30 and 0.15 dB (.0039 SSIM) higher.
OPACITY_PATH = 100.0
LEAST_SHARE = 0.2  # least share of the iterations that run, in any schedule
# Least share of the iterations that run, if iterations were left out before refinement too. Steps then shrink once, and
# no view is watched.
LEAST_SHARE_AFTER_FEW = 0.12
LEAST_STEPS = 400  # least number of iterations, so that steps can shrink
# Least number of iterations, if iterations were left out before refinement too. With 400, scripts of 3,000 iterations
# end 0.1 to 0.2 dB lower on bonsai than with 600, and up to 0.2 dB below their own runs. 600 would take over 40 % of
# the time on fern. Longer schedules need more, as in the growing phase: of 3,000 iterations, 550 lost 0.1 dB on a
# ray-traced scene.
LEAST_STEPS_AFTER_FEW = 550
# Largest share that the least number of iterations can ask for. Where all iterations run, steps are not longer and do
# not shrink: 500 such iterations after its last prune ended 0.3 dB lower than 400 for LightGaussian.
MOST_SHARE_OF_STEPS = 0.8
# Share of the iterations that run if refinement shows each view once. The share falls with the fourth root of the
# number of visits. On bonsai, shares of 0.35, 0.3 and 0.25 lose nothing at 2, 6 and 12 visits.
RARE_SHARE = 0.46
# The same if iterations were left out before refinement, and the number of visits of each view that is enough then.
# Bonsai (255 views at 399x266) lost 0.19 dB (.0045 SSIM) with 10 of 59 visits (30,000 iterations), and nothing with 15
# of them or with 8 of 23 (12,000 iterations). Plant (157 views) lost 0.22 dB (.0091) with 15 of 95 visits and 0.03 dB
# (.0042) with 24, and 0.36 dB (.0110) with 7 of 38 and 0.06 dB (.0036) with 14. Lego gained 0.5 dB with 21 of 150.
RARE_SHARE_AFTER_FEW = 0.75
ENOUGH_VISITS = 24.0
# Least number of visits of each view in refinement, if iterations were left out before it, for trainers that may lower
# the rate of positions too slowly. Inria's script with 7,000 iterations on 255 views of bonsai at 399 pixels ends 0.44
# dB (.011 SSIM) below its own run with 3.4 visits, 0.18 dB (.007) with 4.8, and 0.02 dB above it (-.004) with 6.9. The
# package's trainer ends above its own run with 4 visits there.
REFINING_VISITS = 7.0
# Least share of the iterations that run there, up to `MOST_FOR_SLOW_POSITIONS` iterations; with fewer than 175 views,
# `REFINING_VISITS` asks for less. Of 7,000 iterations, 743 of 3,500 ended 0.27 dB below the own run on a fox's head,
# 1,050 ended 0.13 dB below it, and 1,400 ended 0.05 dB above. Lego ended 0.23 dB below it and 0.05 dB above with the
# first two.
SHARE_FOR_SLOW_POSITIONS = 0.35
MOST_FOR_SLOW_POSITIONS = 1225


def last_part(iterations: int, since_reset: int | None) -> int:
    """Return how many iterations at the end of a run must all run if it ends before densification does, or soon after.

    Args:
        iterations: Iterations of the run.
        since_reset: Iterations of the schedule after the last opacity reset; None without one.
    """
    return max(math.ceil(LAST_PART * iterations), min(since_reset or 0, MOST_LAST))


def longest_positions(visits: float | None) -> float:
    """Return the largest rate of positions in refinement, as a multiple of their first one.

    Args:
        visits: Number of iterations of refinement that run, per training view; None if the views are unknown.
    """
    return LONGEST_POSITIONS * max(1.0, (visits or 0.0) / AVERAGING_VISITS)


def opacity_rate(steps: float) -> float:
    """Return the least learning rate at which opacities recover from their last reset.

    Args:
        steps: Number of steps that they take from that reset to the end of the run.
    """
    return OPACITY_PATH / max(steps, 1.0)


def refining_share(iterations: int, epoch: int, grown: int = 0, slow_positions: bool = False) -> float:
    """Return the share of the refinement iterations that may be needed, as far as it is known beforehand.

    The share is a fifth, or less if iterations were left out before. It is larger in a schedule of few iterations, or
    of few iterations per view, and 1 if not every view comes up once. Where iterations were left out before, refinement
    that is shorter than half of the schedule needs as many iterations as half of the schedule would: 3DGS-MCMC grows
    for five sixths of it.

    Args:
        iterations: Refinement iterations of the schedule.
        epoch: Number of iterations in which every view comes up once.
        grown: Iterations of the schedule before refinement, if some of them were left out; else 0.
        slow_positions: See `TrainerInfo`.
    """
    if iterations < epoch:
        return 1.0
    if not grown:
        return min(1.0, max(LEAST_SHARE, LEAST_STEPS / iterations, RARE_SHARE * (epoch / iterations) ** 0.25))
    half = max(iterations, (grown + iterations) / 2)
    steps = max(LEAST_STEPS_AFTER_FEW * _longer(half), LEAST_SHARE_AFTER_FEW * half)
    visits = min(RARE_SHARE_AFTER_FEW * (epoch / half) ** 0.25 * half, ENOUGH_VISITS * epoch, MOST_RAISED_SHARE * half)
    if slow_positions:
        visits = max(visits, REFINING_VISITS * epoch)
        steps = max(steps, min(SHARE_FOR_SLOW_POSITIONS * half, MOST_FOR_SLOW_POSITIONS))
    return min(MOST_SHARE_OF_STEPS, max(steps, visits) / iterations)


def _longer(iterations: float) -> float:
    """Return the factor on the least number of iterations of a phase, for a schedule of so many iterations."""
    return max(1.0, iterations / SHORT_PHASE) ** LONGER_PHASE


def growing_share(
    iterations: int,
    epoch: int,
    longer: bool,
    events: int = 0,
    shown_of_random: float | None = None,
    resets: bool = True,
    moved: bool = False,
) -> float:
    """Return the share of the iterations before the end of densification that is needed.

    Args:
        iterations: Iterations of the schedule until densification ends.
        epoch: Number of iterations in which each training view comes up once.
        longer: Whether longer steps may replace iterations; see `growing_factor`.
        events: Number of densification events, if all of them run; 0 if events are left out.
        shown_of_random: Share of the Gaussians that a view shows, if the scene begins with random points; else None.
        resets: Whether opacities are reset in these iterations, or it is not known.
        moved: Whether random points need not fade, because they are moved to where they are needed.
    """
    if iterations < 1:
        return 1.0
    visits = GROWING_VISITS if resets or not longer else GROWING_VISITS_WITHOUT_RESETS
    steps = LEAST_GROWING_STEPS_LONGER * _longer(iterations) if longer else LEAST_GROWING_STEPS
    from_random = 0.0
    if shown_of_random and moved:
        from_random = GROWING_SIGHTS_IF_MOVED / shown_of_random
    elif shown_of_random:
        from_random = max(GROWING_STEPS_FROM_RANDOM, GROWING_SIGHTS_FROM_RANDOM / shown_of_random)
    needed = max(steps, min(STEPS_PER_EVENT * events, LEAST_GROWING_STEPS), from_random, visits * epoch)
    return min(1.0, max(LEAST_GROWING_SHARE, needed / iterations))


def share_after_reset(iterations: int) -> float:
    """Return the least share of the iterations that runs after the last opacity reset of the growing phase.

    Args:
        iterations: Iterations of the schedule from the reset to the end of densification.
    """
    return min(1.0, STEPS_AFTER_RESET / iterations) if iterations <= LATE_RESET else 0.0


def share_factor(growth: float) -> float:
    """Return the factor on the share of the iterations that runs after a densification event, at least 1.

    Args:
        growth: Number of Gaussians that the event added, as a share of those before it.
    """
    return max(1.0, growth / GROWTH_PER_EVENT)


def share_after_event(share: float, growth: float, stretch: float, by_budget: bool = False) -> float:
    """Return the share of the iterations that a densification event asks for until the following one.

    Args:
        share: Share of the phase.
        growth: Number of Gaussians that the event added, as a share of those before it.
        stretch: Result of `for_new_gaussians`.
        by_budget: Whether a budget or a share per event sets the number of Gaussians. Growth does not tell what the
            scene needs then, and does not multiply the share of the phase.
    """
    return min(1.0, max(LEAST_GROWING_SHARE * stretch, 0.0 if by_budget else share) * share_factor(growth))


def most_raised(iterations: int, stretch: float, slow_positions: bool) -> float:
    """Return the largest share of a phase's iterations that runs because of new Gaussians.

    Inria's script with 7,000 iterations on plant, which grows to 8 times its points, ends .0031 SSIM below its own run
    with two fifths of both phases, with 71 % of its Gaussians, and .0016 above it with more (86 %). The package's
    trainer ends above its own run with two fifths.

    Args:
        iterations: Iterations of the phase.
        stretch: Result of `for_new_gaussians`.
        slow_positions: See `TrainerInfo`.
    """
    return MOST_RAISED_SHARE * (min(stretch, _longer(iterations)) if slow_positions else 1.0)


def raised_share(share: float, wanted: float, most: float = MOST_RAISED_SHARE) -> float:
    """Return the share of a phase's iterations that runs if new Gaussians ask for `wanted` instead of `share`.

    Args:
        share: Share without new Gaussians.
        wanted: Share that they ask for.
        most: Result of `most_raised`.
    """
    return max(share, min(wanted, most))


def for_new_gaussians(times_grown: float | None) -> float:
    """Return the factor on the share of the iterations for Gaussians that densification added, at least 1.

    Args:
        times_grown: Present number of Gaussians, as a multiple of those when densification began; None if unknown.
    """
    return 1.0 + NEW_GAUSSIANS * (_strongly_grown(times_grown) - 1.0)


def _strongly_grown(times_grown: float | None) -> float:
    """Return the logarithm of the multiple by which a scene grew, or 1 if it grew to e times its Gaussians at most."""
    return 1.0 if times_grown is None else math.log(max(times_grown, math.e))


def growing_factor(
    iterations: int,
    share: float,
    visible: float | None,
    by_budget: bool = False,
    times_grown: float | None = None,
    resets: bool = True,
    refined: bool = True,
) -> float:
    """Return the factor on learning rates while the scene grows.

    In few iterations parameters do not travel far enough, and longer steps make up for that. The factor is at most the
    one that conserves the path of all iterations, which is the mean of `path_factor`.

    Args:
        iterations: Iterations of the schedule until densification ends.
        share: Share of them that runs, in (0, 1].
        visible: Share of the Gaussians that a view shows; None before it is measured.
        by_budget: Whether a budget or a share per event sets the number of Gaussians.
        times_grown: Present number of Gaussians, as a multiple of those when densification began; None if unknown.
        resets: Whether opacities are reset in these iterations, or it is not known.
        refined: Whether a refinement follows that is longer than the recovery from a reset.
    """
    if visible is None or share >= 1.0:
        return 1.0
    conserved = math.sqrt(3.0 * visible) / share
    if not resets:
        longest = LONGEST_STEPS_BY_BUDGET_WITHOUT_RESETS if by_budget else LONGEST_STEPS_WITHOUT_RESETS
        return max(1.0, min(longest, conserved))
    if not refined:
        return max(1.0, min(LONGEST_STEPS_WITHOUT_REFINEMENT, conserved))
    longest = LONGEST_STEPS_BY_BUDGET if by_budget else LONGEST_STEPS
    enough = ENOUGH_STEPS * min(MOST_FOR_NEW_GAUSSIANS, _strongly_grown(times_grown))
    return max(1.0, min(longest, conserved, (enough / math.ceil(share * iterations)) ** 2))


def geometry_part(factor: float, longest: float) -> float:
    """Return the multiple of the common factor that positions or scales take while the scene grows, from 1 to 2.

    Args:
        factor: The common factor.
        longest: Largest factor on their rate, if the common one is not larger.
    """
    return min(GEOMETRY, max(1.0, longest / factor))


def opacity_factor(share: float) -> float:
    """Return the factor on the learning rate of opacities while the scene grows.

    Resets happen as often as in the trainer's own run, so opacities have a share of the iterations to recover from
    each. At their own rate they do not: with a tenth of 15,000 iterations, their mean on bonsai was 0.10 instead of
    0.38 when densification ended. The image was translucent, and each iteration took a quarter longer. The factor that
    conserves their whole path, 1 / share, makes them flicker, and prunes too many Gaussians. Its root does not.

    Args:
        share: Share of the iterations that runs, in (0, 1].
    """
    return 1.0 / math.sqrt(share)
