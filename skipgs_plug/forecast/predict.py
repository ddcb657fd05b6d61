"""Predict whole runs from a pilot: fit curves to its measurements, and add up their values."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from statistics import fmean as mean

import numpy as np

from skipgs_plug.core.pace.densification_events import DensificationEvents
from skipgs_plug.core.pace.needs import (
    for_new_gaussians,
    growing_share,
    raised_share,
    refining_share,
    share_after_event,
)
from skipgs_plug.core.trainer_info import Densification
from skipgs_plug.forecast.pilot import GROUP, Pilot
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.strategy import reset_interval

# The duration of an iteration grows with a power of the number of Gaussians. Whole runs on fern show a power of one
# half. A pilot corrects it, by more if its own numbers of Gaussians differ more.
USUAL_POWER = 0.5
# Weight of the usual power. The pilot's own power counts as much if the weighted squared deviations of the logarithm
# of its numbers of Gaussians add up to this value.
POWER_WEIGHT = 1.0
# The number of Gaussians approaches its final value as 1 - exp(-rate * x). x is the finished part of densification.
USUAL_RATE = 2.2
# Weight of log(rate / USUAL_RATE)**2 against the sum of squared errors, which are relative to the largest growth.
RATE_WEIGHT = 0.002
RATES = np.geomspace(0.3, 12.0, 80)  # rates that the fit tries
# Peak memory of one Gaussian in bytes: parameters, gradients, moments and lists. Measured on fern.
BYTES_OF_A_GAUSSIAN = 2400
# Duration of an iteration on a photograph of half the size, as a part of one at its own size. Measured on bonsai at
# 798x531 pixels (0.46) and on a ray-traced scene at 640x480.
SECONDS_AT_HALF_SIZE = 0.5


@dataclass(frozen=True)
class Forecast:
    """Predicted time, size and memory of a run.

    Attributes:
        max_steps: Number of iterations in the schedule.
        seconds: Training time in seconds if every iteration runs.
        seconds_auto: Training time in seconds with `share="auto"`.
        iterations_auto: Number of iterations that run with `share="auto"`.
        gaussians: Number of Gaussians at the end.
        memory: Peak memory in bytes; None if the pilot did not measure it.
    """

    max_steps: int
    seconds: float
    seconds_auto: float
    iterations_auto: int
    gaussians: int
    memory: int | None


def predict(pilot: Pilot, config: TrainConfig, max_steps: int) -> Forecast:
    """Return the forecast of a run of `max_steps` iterations with the settings of the pilot."""
    schedule = TrainConfig(
        strategy=config.strategy,
        refine_stop_iter=config.refine_stop_iter,
        reset_every=config.reset_every,
        max_steps=max_steps,
    )
    stop = min(schedule.scaled(schedule.recipe.refine_stop_iter), max_steps)
    growth = fit_growth(pilot, config)
    cost = fit_cost(pilot)
    # Densification events are as far apart in short schedules as in long ones, so a shorter schedule ends at the point
    # that the pilot's curve reaches by then. A longer schedule has more events but also prunes more: after 30,000
    # iterations bonsai has 0.8 and Lego 1.7 times the Gaussians that it has after 7,000.
    end = min(1.0, stop / pilot.stop)
    grown = growth(end)
    numbers = [growth(x) for x in np.linspace(0.0, end, 101)]
    costs = [cost(number) for number in numbers]
    per_growing = mean(costs)
    per_refining = cost(grown)
    resets = schedule.strategy == "mcmc" or reset_interval(schedule) < stop
    growing = stop * growing_share_of(pilot, config, stop, resets, numbers[-1] / numbers[0])
    left, refining = max_steps - stop, 0.0
    if left:
        share = refining_share(left, pilot.views, grown=stop)
        refining = left * raised_share(share, share * for_new_gaussians(grown / numbers[0]))
    more = grown - max(sample.gaussians for sample in pilot.samples)
    memory = None if pilot.peak_memory is None else round(pilot.peak_memory + BYTES_OF_A_GAUSSIAN * max(more, 0.0))
    # Photographs have half their size until the scene grows strongly.
    halved = [pilot.half_size and for_new_gaussians(number / numbers[0]) == 1.0 for number in numbers]
    per_grown = mean(one * (SECONDS_AT_HALF_SIZE if half else 1.0) for one, half in zip(costs, halved, strict=True))
    return Forecast(
        max_steps=max_steps,
        seconds=stop * per_growing + (max_steps - stop) * per_refining,
        seconds_auto=growing * per_grown + refining * per_refining,
        iterations_auto=round(growing + refining),
        gaussians=round(grown),
        memory=memory,
    )


def growing_share_of(pilot: Pilot, config: TrainConfig, stop: int, resets: bool, times_grown: float) -> float:
    """Return the share of the iterations before the end of densification that `share="auto"` runs.

    Each event is taken to add the same share of the Gaussians; see `core.pace.growing` for the rule.

    Args:
        pilot: The pilot.
        config: Its settings.
        stop: Iteration at which densification ends.
        resets: Whether opacities must recover meanwhile, from resets or from MCMC's regulariser.
        times_grown: Number of Gaussians then, as a multiple of those at the beginning.
    """
    shown = pilot.visible if pilot.fading else None
    share = growing_share(stop, pilot.views, pilot.visible is not None, shown_of_random=shown, resets=resets)
    if config.strategy == "mcmc" or times_grown <= 1.0:
        return share
    events = DensificationEvents(range(config.refine_every, stop, config.refine_every), Densification())
    needed = max(events.needed(config.refine_every, pilot.visible, share, stop), 1)
    raised = share
    for _ in range(2):  # more iterations run more events, each of which adds less
        run = min(max(len(events), 1), max(raised * stop / needed, 1.0))
        growth = times_grown ** (1.0 / run) - 1.0
        raised = raised_share(share, share_after_event(share, growth, for_new_gaussians(times_grown)))
    return raised


class Growth:
    """Number of Gaussians as a function of the finished part of densification, in [0, 1]."""

    def __init__(self, first: float, lowest: float, begin: float, added: float, rate: float, most: float) -> None:
        self._first, self._lowest, self._begin, self._added = first, lowest, begin, added
        self._rate, self._most = rate, most

    def __call__(self, part: float) -> float:
        if part <= self._begin:
            return self._first
        return min(self._lowest + self._added * growth_shape(part, self._begin, self._rate), self._most)


def growth_shape(part: float, begin: float, rate: float) -> float:
    """Return the finished share of the growth when a part of densification is finished; growth starts at `begin`."""
    if part <= begin:
        return 0.0
    return math.expm1(-rate * (part - begin)) / math.expm1(-rate * (1.0 - begin))


def fit_growth(pilot: Pilot, config: TrainConfig) -> Growth:
    """Fit a curve to the numbers of Gaussians in the pilot, and return it.

    Growth is counted from the lowest number: most random points, from which some scenes begin, are pruned first. If the
    pilot passed the end of densification, the curve ends at the pilot's last number.
    """
    most = math.inf if config.strategy == "default" else float(max(config.cap_max, pilot.first_gaussians))
    begin = config.refine_start_iter / config.recipe.refine_stop_iter
    first = lowest = float(pilot.first_gaussians)
    grown = [sample for sample in pilot.samples if sample.step < pilot.stop]
    pruned = min(grown, key=lambda sample: sample.gaussians, default=None)
    if pruned is not None and pruned.gaussians < first:
        lowest, begin = float(pruned.gaussians), max(begin, pruned.step / pilot.stop)
        grown = [sample for sample in grown if sample.step >= pruned.step]
    # One point for each change of the number of Gaussians, which the iterations between events do not change.
    events = [b for a, b in itertools.pairwise(grown) if b.gaussians != a.gaussians]
    parts = np.array([sample.step / pilot.stop for sample in events])
    counts = np.array([sample.gaussians for sample in events]) - lowest
    over = [sample for sample in pilot.samples if sample.step >= pilot.stop]
    if not events:
        last = over[-1].gaussians if over else pilot.samples[-1].gaussians
        return Growth(first, lowest, begin, last - lowest, USUAL_RATE, most)
    best: tuple[float, float, float] | None = None
    for rate in RATES:
        shape = np.array([growth_shape(part, begin, rate) for part in parts])
        met = float(shape @ counts) / max(float(shape @ shape), 1e-12)
        added = over[-1].gaussians - lowest if over else met
        scale = max(float(np.abs(counts).max()), 1.0)
        error = float(np.mean((added * shape - counts) ** 2)) / scale**2
        error += RATE_WEIGHT * math.log(rate / USUAL_RATE) ** 2 / len(parts)
        if best is None or error < best[0]:
            best = error, added, float(rate)
    assert best is not None
    return Growth(first, lowest, begin, best[1], best[2], most)


class Cost:
    """Duration of an iteration in seconds as a function of the number of Gaussians."""

    def __init__(self, seconds: float, gaussians: float, power: float) -> None:
        self._seconds, self._gaussians, self._power = seconds, gaussians, power

    def __call__(self, gaussians: float) -> float:
        return self._seconds * (max(gaussians, 1.0) / self._gaussians) ** self._power


def fit_cost(pilot: Pilot) -> Cost:
    """Fit a curve to the durations of groups of iterations; late groups, like the iterations to come, weigh more."""
    groups = [pilot.samples[at : at + GROUP] for at in range(0, len(pilot.samples), GROUP)]
    groups = [group for group in groups if len(group) == GROUP] or [pilot.samples]
    times = np.log(np.array([mean(max(sample.seconds, 1e-9) for sample in group) for group in groups]))
    counts = np.log(np.array([mean(max(sample.gaussians, 1) for sample in group) for group in groups]))
    weights = np.linspace(0.2, 1.0, len(groups))
    middle, level = np.average(counts, weights=weights), np.average(times, weights=weights)
    x, y = counts - middle, times - level
    spread = float(weights @ (x * x))
    power = (float(weights @ (x * y)) + POWER_WEIGHT * USUAL_POWER) / (spread + POWER_WEIGHT)
    return Cost(float(np.exp(level)), float(np.exp(middle)), min(max(power, 0.0), 1.0))
