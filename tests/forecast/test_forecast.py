"""Forecasts: curves that are met, numbers of iterations that runs take, errors that were measured, the command."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from skipgs_plug import SkipGate
from skipgs_plug.cli import main
from skipgs_plug.commands.estimate import errors_seen
from skipgs_plug.forecast.errors import QUANTITIES, error, measured_errors, spread
from skipgs_plug.forecast.pilot import GROUP, PILOT_STEPS, Pilot, Sample, run_pilot
from skipgs_plug.forecast.predict import fit_cost, fit_growth, growth_shape, predict
from skipgs_plug.trainer import TrainConfig, Trainer, save_packed
from skipgs_plug.trainer.synthetic import make_scene

FIRST, ADDED, STOP, BEGIN = 5000, 20_000, 3500, 500 / 15_000


def pilot_of(
    until: float, rate: float = 2.2, seconds: Callable[[float], float] = lambda count: 0.01, peak: int | None = None
) -> Pilot:
    """Return a pilot that ran every fourth iteration up to a part of densification, on curves that are known."""
    samples = []
    for step in range(0, round(until * STOP), 4):
        count = FIRST + ADDED * growth_shape(step // 100 * 100 / STOP, BEGIN, rate)  # events every 100 iterations
        samples.append(Sample(step, round(count), seconds(count)))
    return Pilot(tuple(samples), FIRST, 20, 0.3, STOP, half_size=False, peak_memory=peak, fading=False)


@pytest.mark.parametrize("rate", [1.0, 2.2, 5.0])
@pytest.mark.parametrize("until", [0.5, 1.0])
def test_growth_is_continued(rate: float, until: float) -> None:
    growth = fit_growth(pilot_of(until, rate), TrainConfig())
    assert growth(0.0) == FIRST and growth(1.0) == pytest.approx(FIRST + ADDED, rel=0.08)
    assert growth(0.3) == pytest.approx(FIRST + ADDED * growth_shape(0.3, BEGIN, rate), rel=0.05)


def test_growth_that_has_ended_is_met() -> None:
    seen = pilot_of(1.0)
    over = dataclasses.replace(seen, samples=(*seen.samples, Sample(STOP, 26_123, 0.01)))
    assert fit_growth(over, TrainConfig())(1.0) == pytest.approx(26_123)


def test_without_an_event_nothing_is_said_to_grow() -> None:
    early = pilot_of(0.02)
    assert fit_growth(early, TrainConfig())(1.0) == FIRST and not early.grew
    assert pilot_of(0.2).grew
    ended = dataclasses.replace(early, samples=(*early.samples, Sample(STOP, FIRST, 0.01)))
    assert ended.grew  # no event adds a Gaussian to such a scene


def test_growth_is_counted_from_the_lowest_number() -> None:
    seen = pilot_of(0.5)
    random = dataclasses.replace(seen, first_gaussians=4 * FIRST)  # most of its points are pruned at once
    growth = fit_growth(random, TrainConfig())
    assert growth(0.0) == 4 * FIRST and growth(1.0) == pytest.approx(FIRST + ADDED, rel=0.08)
    still = dataclasses.replace(pilot_of(0.02), first_gaussians=4 * FIRST)
    assert not still.grew and fit_growth(still, TrainConfig())(1.0) == FIRST


def test_without_an_event_the_command_gives_lower_bounds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    assert main(["estimate", str(path), "--seconds", "0.0001", "--no-progress", "--backend", "warp"]) == 0
    shown = capsys.readouterr().out
    assert f"{GROUP + 1} iterations in" in shown
    assert shown.count("at least 160 ") == 2 and "at least" in shown.splitlines()[3].split("160")[0]
    assert "No densification that adds Gaussians was seen" in shown and "a lower bound" in shown
    assert "give a larger --seconds than 0.0001." in shown and "Errors of such estimates" not in shown


def test_mcmc_grows_no_further_than_its_cap() -> None:
    config = TrainConfig(strategy="mcmc", cap_max=12_000)
    assert fit_growth(pilot_of(0.5), config)(1.0) == 12_000


def test_a_scene_of_random_points_needs_more_iterations() -> None:
    usual = pilot_of(1.0)
    random = dataclasses.replace(usual, fading=True)
    assert predict(random, TrainConfig(), 7000).iterations_auto > predict(usual, TrainConfig(), 7000).iterations_auto


@pytest.mark.parametrize("power", [0.2, 0.5, 0.9])
def test_the_cost_of_an_iteration_follows_what_was_seen(power: float) -> None:
    cost = fit_cost(pilot_of(1.0, seconds=lambda count: 0.02 * (count / 10_000) ** power))
    assert cost(20_000) == pytest.approx(0.02 * 2**power, rel=0.05)
    assert cost(50_000) == pytest.approx(
        0.02 * 5**power, rel=0.35
    )  # beyond the measured numbers the usual power counts too


def test_a_longer_run_takes_longer_and_auto_takes_less() -> None:
    seen = pilot_of(1.0, peak=10**9)
    short, long = (predict(seen, TrainConfig(), steps) for steps in (7000, 30_000))
    assert short.seconds == pytest.approx(70, rel=0.03) and long.seconds == pytest.approx(300, rel=0.03)
    for one in (short, long):
        assert one.iterations_auto < one.max_steps
        assert one.seconds_auto == pytest.approx(0.01 * one.iterations_auto, rel=0.03)
    assert short.memory is not None and short.memory >= 10**9


def test_a_scene_whose_events_add_much_runs_more_iterations() -> None:
    grows = pilot_of(1.0)
    still = dataclasses.replace(grows, samples=tuple(Sample(one.step, FIRST, 0.01) for one in grows.samples))
    more, few = (predict(pilot, TrainConfig(), 7000).iterations_auto for pilot in (grows, still))
    assert 1.2 * few < more < 0.8 * 7000


def test_growth_on_smaller_photographs_takes_less() -> None:
    pilot = pilot_of(0.5)
    plain = predict(pilot, TrainConfig(), 7000)
    smaller = predict(dataclasses.replace(pilot, half_size=True), TrainConfig(), 7000)
    assert smaller.seconds == plain.seconds and smaller.iterations_auto == plain.iterations_auto
    # The scene has e times its Gaussians after a third of densification, and photographs their own size from then on.
    assert 0.8 * plain.seconds_auto < smaller.seconds_auto < 0.95 * plain.seconds_auto


def test_a_shorter_run_ends_where_growth_is_by_then() -> None:
    seen = pilot_of(1.0)
    whole, half = (predict(seen, TrainConfig(), steps).gaussians for steps in (7000, 3500))
    assert whole == pytest.approx(FIRST + ADDED, rel=0.05)
    assert half == pytest.approx(FIRST + ADDED * growth_shape(0.5, BEGIN, 2.2), rel=0.05)
    assert predict(seen, TrainConfig(), 30_000).gaussians == whole


@pytest.mark.parametrize("max_steps", [60, 600])
def test_auto_runs_as_many_iterations_as_forecast(max_steps: int) -> None:
    scene = make_scene(n_views=10, width=16, height=12, n_points=40)
    config = TrainConfig(backend="warp", max_steps=max_steps, refine_every=10)
    seen = run_pilot(config, scene, 0.5)
    trainer = Trainer(config, scene)
    with SkipGate(trainer, share="auto"):
        trainer.train(progress=False)
    assert predict(seen, config, max_steps).iterations_auto == pytest.approx(trainer.ran, rel=0.1, abs=3)


def test_a_pilot_ends_in_time_and_keeps_its_hands_off() -> None:
    scene = make_scene(n_views=10, width=32, height=24, n_points=160)
    seen = run_pilot(TrainConfig(backend="warp", refine_every=20), scene, 0.2)
    total = sum(sample.seconds for sample in seen.samples)
    last = seen.samples[-1].seconds
    assert total - last < 0.2 <= total
    assert seen.views == 8 and [sample.step for sample in seen.samples] == sorted({s.step for s in seen.samples})


def test_errors_were_measured_and_are_printed() -> None:
    rows = measured_errors()["rows"]
    assert rows
    for row in rows:
        assert row["quantity"] in QUANTITIES and row["expected"] > 0 and row["measured"] > 0 and 0 < row["part"] < 0.5
    found = spread(rows, "seconds_auto")
    assert found is not None
    low, high, count = found
    assert low == min(error(row) for row in rows if row["quantity"] == "seconds_auto") and low <= high
    assert f"with --share auto {100 * low:+.0f} to {100 * high:+.0f} % (runs: {count})" in errors_seen()
    assert spread(rows, "nothing") is None


@pytest.mark.parametrize("grown", [False, True])
def test_an_error_counts_only_if_the_pilot_did_not_see_the_end(grown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    compare = importlib.import_module("forecast").compare
    run = {"how": "auto", "seconds": 20.0, "iterations": 2000, "gaussians": 30_000, "memory": None}
    long = {"scene": "fern", "how": "own", "seconds": None, "iterations": 30_000, "gaussians": 40_000, "memory": None}
    forecast = {"seconds": 1.0, "seconds_auto": 10.0, "iterations_auto": 1000, "gaussians": 20_000, "memory": 1}
    forecasts = [{**forecast, "max_steps": steps} for steps in (PILOT_STEPS, 30_000)]
    pilot = {"iterations": 500, "grown": grown, "forecasts": forecasts}
    stored = {"fern": {"pilot": pilot, "runs": [{**run, "max_steps": PILOT_STEPS}]}}
    rows = compare(stored, [{**long, "max_steps": 30_000}])
    found = {(row["max_steps"], row["quantity"]): error(row) for row in rows}
    of_the_pilots_schedule = {(7000, quantity): -0.5 for quantity in ("seconds_auto", "iterations_auto")}
    of_the_pilots_schedule[7000, "gaussians"] = pytest.approx(-1 / 3)
    assert found == {**({} if grown else of_the_pilots_schedule), (30_000, "gaussians"): -0.5}
    assert {row["part"] for row in rows} == {round(500 / 30_000, 3)} | (set() if grown else {0.25})


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Pilot, "grew", True)  # whether so short a pilot gets that far depends on the machine
    command = ["estimate", str(path), "--seconds", "0.3", "--steps", "700", "7000", "--no-progress"]
    assert main(command) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("demo, 8 training views: ")
    assert [line.split()[0] for line in shown[2:5]] == ["iterations", "700", "7,000"]
    assert any(line.startswith("Errors of such estimates on ") for line in shown)
    assert [entry.name for entry in tmp_path.iterdir()] == ["tiny.npz"]  # nothing is written
    for wrong in (["--seconds", "0"], ["--steps", "0"], ["--seconds", str(math.nan)]):
        assert main(["estimate", str(path), *wrong]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"skipgs-plug: {wrong[0]} ") and "give" in said and said.count("\n") == 1
