"""From a pilot to whole runs: curves through what was seen, and sums over them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from statistics import fmean as mean

import numpy as np

from skipgs_plug.core.pace.needs import growing_share, refining_share
from skipgs_plug.forecast.pilot import Pilot
from skipgs_plug.trainer.config import TrainConfig

# Seconds of an iteration go with a power of the number of Gaussians. Half is what whole runs on fern show; a pilot
# moves it as far as its own numbers of Gaussians differ.
USUAL_POWER = 0.5
POWER_WEIGHT = 1.0  # groups of iterations, one unit of logarithm apart, that outweigh the usual power
GROUP = 20  # iterations whose mean time counts as one measurement
# The number of Gaussians approaches its end as 1 - exp(-rate * x), x being the part of densification that is done.
USUAL_RATE = 2.2
RATE_WEIGHT = 0.002  # of the squared logarithm of the rate against squared errors, as a share of the growth
RATES = np.geomspace(0.3, 12.0, 80)
BYTES_OF_A_GAUSSIAN = 2400  # of peak memory: parameters, gradients, moments, lists; measured on fern


@dataclass(frozen=True)
class Forecast:
    """What a run is expected to take.

    Attributes:
        max_steps: its length.
        seconds: of training, every iteration run.
        seconds_auto: of training with `share="auto"`.
        iterations_auto: iterations that run then.
        gaussians: at the end.
        memory: peak of bytes; None if it was not measured.
    """

    max_steps: int
    seconds: float
    seconds_auto: float
    iterations_auto: int
    gaussians: int
    memory: int | None


def predict(pilot: Pilot, config: TrainConfig, max_steps: int) -> Forecast:
    """Return the forecast of a run of `max_steps` iterations with the settings of the pilot."""
    schedule = TrainConfig(strategy=config.strategy, refine_stop_iter=config.refine_stop_iter, max_steps=max_steps)
    stop = min(schedule.scaled(schedule.recipe.refine_stop_iter), max_steps)
    growth = fit_growth(pilot, config)
    cost = fit_cost(pilot)
    # Events are as far apart in short schedules as in long ones, so a shorter one ends where the pilot's curve is by
    # then. Longer ones have more, and more that is pruned: Lego and bonsai end with about as many Gaussians.
    end = min(1.0, stop / pilot.stop)
    grown = growth(end)
    per_growing = float(np.mean([cost(growth(x)) for x in np.linspace(0.0, end, 101)]))
    per_refining = cost(grown)
    growing = growing_share(stop, pilot.views, longer=pilot.shown is not None) * stop
    left = max_steps - stop
    refining = refining_share(left, pilot.views, grown=stop) * left if left else 0.0
    more = grown - max(sample.gaussians for sample in pilot.samples)
    memory = None if pilot.peak_memory is None else round(pilot.peak_memory + BYTES_OF_A_GAUSSIAN * max(more, 0.0))
    return Forecast(
        max_steps=max_steps,
        seconds=stop * per_growing + (max_steps - stop) * per_refining,
        seconds_auto=growing * per_growing + refining * per_refining,
        iterations_auto=round(growing + refining),
        gaussians=round(grown),
        memory=memory,
    )


class Growth:
    """Number of Gaussians by the part of densification that is done, in [0, 1]."""

    def __init__(self, first: float, begin: float, added: float, rate: float, most: float) -> None:
        self._first, self._begin, self._added, self._rate, self._most = first, begin, added, rate, most

    def __call__(self, part: float) -> float:
        return min(self._first + self._added * growth_shape(part, self._begin, self._rate), self._most)


def growth_shape(part: float, begin: float, rate: float) -> float:
    """Share of the growth that is done after a part of densification; growth begins at `begin`."""
    if part <= begin:
        return 0.0
    return math.expm1(-rate * (part - begin)) / math.expm1(-rate * (1.0 - begin))


def fit_growth(pilot: Pilot, config: TrainConfig) -> Growth:
    """Return the curve of the number of Gaussians that runs through those of the pilot.

    Where the pilot has passed the end of densification, its last number is met.
    """
    most = math.inf if config.strategy == "default" else float(max(config.cap_max, pilot.first_gaussians))
    begin = config.refine_start_iter / config.recipe.refine_stop_iter
    first = float(pilot.first_gaussians)
    grown = [sample for sample in pilot.samples if sample.step < pilot.stop]
    # One point for each number of Gaussians: the events, not the iterations between them.
    events = [b for a, b in itertools.pairwise(grown) if b.gaussians != a.gaussians]
    parts = np.array([sample.step / pilot.stop for sample in events])
    counts = np.array([sample.gaussians for sample in events]) - first
    over = [sample for sample in pilot.samples if sample.step >= pilot.stop]
    if not events:
        last = over[-1].gaussians if over else pilot.samples[-1].gaussians
        return Growth(first, begin, last - first, USUAL_RATE, most)
    best: tuple[float, float, float] | None = None
    for rate in RATES:
        shape = np.array([growth_shape(part, begin, rate) for part in parts])
        met = float(shape @ counts) / max(float(shape @ shape), 1e-12)
        added = over[-1].gaussians - first if over else met
        scale = max(float(np.abs(counts).max()), 1.0)
        error = float(np.mean((added * shape - counts) ** 2)) / scale**2
        error += RATE_WEIGHT * math.log(rate / USUAL_RATE) ** 2 / len(parts)
        if best is None or error < best[0]:
            best = error, added, float(rate)
    assert best is not None
    return Growth(first, begin, best[1], best[2], most)


class Cost:
    """Seconds of an iteration by the number of Gaussians."""

    def __init__(self, seconds: float, gaussians: float, power: float) -> None:
        self._seconds, self._gaussians, self._power = seconds, gaussians, power

    def __call__(self, gaussians: float) -> float:
        return self._seconds * (max(gaussians, 1.0) / self._gaussians) ** self._power


def fit_cost(pilot: Pilot) -> Cost:
    """Return the curve through the seconds of groups of iterations; late groups, like those to come, weigh more."""
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
