"""Whole runs: each policy from the first iteration on."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import math
import os

import pytest
from bench_fixtures import Finished, make_bench
from hypothesis import given
from hypothesis import strategies as st

from skipgs_plug.bench.memory import memory_meter
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.refine import MOST_DB, measured, peak_memory
from skipgs_plug.bench.sampling import periodic_numbers, random_numbers
from skipgs_plug.bench.summary import summarise
from skipgs_plug.bench.table import WHOLE, cells, notes, searched
from skipgs_plug.bench.whole import PARTS, events, nearest, next_setting, same, search
from skipgs_plug.bench.whole_policies import WHOLE_POLICIES
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.synthetic import make_scene

STEPS = 200  # densification ends at 100; the scene has 6 views
SHARE = "share=0.4"


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory) -> Finished:
    folder = tmp_path_factory.mktemp("whole")
    bench = make_bench(scene, folder, seeds=(0,), policies=tuple(WHOLE_POLICIES), max_steps=STEPS, whole=True)
    return Finished(bench, bench.run(), folder)


def test_every_policy_ran_from_the_first_iteration(whole):
    for record in whole.records:
        assert record.status == "done", record.note
        assert record.trace.start == record.points[0].step == 0 and record.points[0].seconds == 0.0
        assert record.points[-1].step == record.iterations == len(record.trace.codes)
        assert record.points[-1].seconds == record.t_total >= record.t_post > 0.0
        assert record.points[-1].metrics["psnr"] == record.metrics["psnr"]
        assert record.metrics["num_GS"] > 0


def test_the_own_run_equals_one_without_a_bench(whole, scene):
    trainer = Trainer(TrainConfig(max_steps=STEPS, seed=0), scene)
    trainer.train(progress=False)
    own = whole.run("own")
    assert own.metrics["psnr"] == trainer.evaluate("test")["psnr"]
    assert own.iterations_run == STEPS and len(own.points) == PARTS + 1


def test_time_is_of_the_processor_with_the_wall_beside_it(whole):
    for record in whole.records:
        assert record.t_total == record.seconds["t_total_processor"]
        assert record.seconds["t_total"] > 0.0
        assert sum(record.phases.values()) == pytest.approx(record.t_total, rel=1e-6)


def test_a_share_is_planned_for_the_whole_run_although_it_is_trained_in_parts(whole, scene):
    from skipgs_plug import SkipGate

    trainer = Trainer(TrainConfig(max_steps=STEPS, seed=0), scene)
    with SkipGate(trainer, share=0.4) as gate:
        trainer.train(progress=False)
    record, report = whole.run(SHARE), gate.report()
    assert record.iterations_run == report["iterations"] < STEPS
    assert record.metrics["psnr"] == trainer.evaluate("test")["psnr"]
    assert record.chosen["grow_share"] == record.chosen["refine_share"] == 0.4


def test_controls_run_as_often_in_each_phase(scene, tmp_path, monkeypatch):
    import skipgs_plug.bench.whole_policies as module

    monkeypatch.setitem(
        WHOLE_POLICIES, "share=auto", dataclasses.replace(module.whole_policy(SHARE), name="share=auto")
    )
    policies = ("share=auto", "random", "periodic")
    runs = make_bench(scene, tmp_path, seeds=(3,), policies=policies, max_steps=STEPS, whole=True).run()
    copied, *controls = (run.trace.ran for run in runs)
    stop, forced = STEPS // 2, events(Trainer(TrainConfig(max_steps=STEPS), scene))
    for ran in controls:
        assert ran != copied and all(ran[n] for n in forced)
        assert abs(sum(ran[:stop]) - sum(copied[:stop])) <= len(forced)
        assert abs(sum(ran[stop:]) - sum(copied[stop:])) <= 1
    assert controls[0] != controls[1]


def test_searches_say_what_they_tried_and_end_near(whole):
    copied = whole.run("share=auto")
    for policy, setting in (("shortened", "max_steps"), ("own,grow_grad2d", "grow_grad2d")):
        record = whole.run(policy)
        assert record.tries and setting in record.tries[0]
        assert f"{setting} " in searched(record.as_dict(with_trace=False))
    counts = [one["num_GS"] for one in whole.run("own,grow_grad2d").tries]
    nearest_count = min(counts, key=lambda count: abs(math.log(count / copied.metrics["num_GS"])))
    assert whole.run("own,grow_grad2d").metrics["num_GS"] == nearest_count


def test_the_table_has_the_number_of_gaussians_in_every_row(whole):
    rows = summarise(whole.records, tuple(WHOLE_POLICIES), STEPS, whole=True)
    heading, *lines = cells(rows, WHOLE)
    assert heading[2] == "T_total s" and all(line[heading.index("Gaussians")] != "-" for line in lines)
    own = next(row for row in rows if row.policy == "own")
    assert own.values["num_GS_share"].mean == pytest.approx(100.0) == own.values["t_total_share"].mean


def test_a_finished_bench_is_not_run_again(whole, scene):
    said: list[str] = []
    again = make_bench(
        scene, whole.folder, seeds=(0,), policies=tuple(WHOLE_POLICIES), max_steps=STEPS, whole=True, say=said.append
    )
    assert again.run() == whole.records and said == []


def test_one_that_was_killed_goes_on_with_what_is_missing(whole, scene, tmp_path):
    policies = ("own", "share=0.4", "refine_share=auto")
    first = make_bench(scene, tmp_path, seeds=(0,), policies=policies, max_steps=STEPS, whole=True)
    first.run()
    (tmp_path / "runs" / "seed0_share=0.4.json").unlink()
    said: list[str] = []
    again = make_bench(
        scene, tmp_path, seeds=(0,), policies=policies, max_steps=STEPS, whole=True, say=said.append
    ).run()
    assert len(said) == 1 and "share=0.4" in said[0]
    assert again[1].metrics == whole.run("share=0.4").metrics and again[1].trace == whole.run("share=0.4").trace


def test_refinements_and_whole_runs_do_not_share_a_folder(whole, scene):
    from skipgs_plug.trainer import InputError

    with pytest.raises(InputError, match="whole=True, not False"):
        make_bench(scene, whole.folder, seeds=(0,), policies=("own",), max_steps=STEPS)


def test_mcmc_has_no_threshold_of_growth(scene, tmp_path):
    bench = make_bench(
        scene, tmp_path, seeds=(0,), policies=("own", "share=auto", "own,grow_grad2d"), max_steps=40, whole=True
    )
    bench.config.strategy = "mcmc"
    found = {record.policy: record for record in bench.run()}
    assert found["own"].status == "done"
    assert found["own,grow_grad2d"].status == "not run" and "MCMC" in found["own,grow_grad2d"].note


def test_a_view_that_is_hit_exactly_does_not_drop_a_seed(scene, tmp_path, monkeypatch):
    evaluate = Trainer.evaluate

    def with_background(trainer, split="test", lpips_net=None):
        stats = evaluate(trainer, split, lpips_net)
        stats["per_view"][0]["psnr"] = stats["psnr"] = math.inf
        return stats

    monkeypatch.setattr(Trainer, "evaluate", with_background)
    (record,) = make_bench(scene, tmp_path, seeds=(0,), policies=("own",), max_steps=40, whole=True).run()
    assert record.status == "done" and record.exact_views == 1 and record.metrics["psnr"] > MOST_DB / 2
    json.loads((tmp_path / "runs" / "seed0_own.json").read_text())


def test_the_mean_with_exact_views_is_over_all_views():
    rows = [{"view": "a", "psnr": math.inf, "ssim": 1.0}, {"view": "b", "psnr": 20.0, "ssim": 0.5}]
    assert measured({"psnr": math.inf, "ssim": 0.75, "num_GS": 7, "per_view": rows}) == (
        {"psnr": (MOST_DB + 20.0) / 2, "ssim": 0.75, "num_GS": 7},
        1,
    )


def test_exact_views_are_told(whole):
    from test_bench_summary import result_of

    record = RunRecord(2, "own", exact_views=3).as_dict(with_trace=False)
    told = " ".join(notes([], {**result_of([]), "runs": [record]}))
    assert "Seed 2 of own renders 3 held-out views without any error" in told and "100 dB" in told


@given(st.integers(1, 300), st.data())
def test_controls_keep_all_events_and_the_given_number_of_iterations(n, data):
    numbers = range(5, 5 + n)
    forced = data.draw(st.sets(st.sampled_from(numbers), max_size=20))
    count = data.draw(st.integers(0, n))
    for kept in (random_numbers(numbers, forced, count, 1), periodic_numbers(numbers, forced, count, 1)):
        assert forced <= kept <= set(numbers) and len(kept) == max(count, len(forced))


@pytest.mark.parametrize("power", [-1.3, -0.4, 0.7, 1.0])
def test_a_search_meets_what_it_wants_within_its_tries(power):
    def attempt(setting: float):
        yield
        return 500.0 * setting**power + 40.0

    turns = search(attempt, 1.0, 800.0, 0.02, power=math.copysign(1.0, power))
    while True:
        try:
            next(turns)
        except StopIteration as finished:
            tries = finished.value
            break
    assert same(tries[nearest(tries, 800.0)][1], 800.0, 0.02)


def test_noise_does_not_turn_a_search_round():
    # The second try has a higher threshold and, by chance, more Gaussians: the power decides.
    assert next_setting([(1.0, 100.0), (1.1, 101.0)], 90.0, -1.0) == pytest.approx(100.0 / 90.0)


def test_memory_of_a_part_is_seen():
    import torch

    meter = memory_meter(torch.device("cpu"))
    if not os.path.exists("/proc/self/clear_refs") or meter is None:
        pytest.skip("this system does not tell peak memory")
    before = meter.reset()
    held = torch.ones(64 * 2**20, dtype=torch.uint8)
    assert meter.peak() - before >= 0.9 * held.nbytes
    del held
    assert meter.reset() - before < 32 * 2**20
    assert meter.peak() - before < 48 * 2**20


def test_a_run_after_another_needs_as_much_memory():
    """The first leaves memory that was freed in the process, which the second would find."""
    import torch

    if memory_meter(torch.device("cpu")) is None or not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("this system does not tell peak memory, or keeps what was freed")
    scene = make_scene(n_views=4, width=256, height=192, n_points=4000)
    records = [RunRecord(0, "own"), RunRecord(0, "gate")]
    trainers = [Trainer(TrainConfig(max_steps=400), scene) for _ in records]
    for _ in range(2):
        for trainer, record in zip(trainers, records, strict=True):
            with peak_memory(trainer, record):
                trainer.train(until=trainer.step + 5, progress=False)
    first, second = (record.peak_memory for record in records)
    held = sum(parameter.nbytes for parameter in trainers[1].splats.values()) * 3  # parameters and two moments
    assert second > 1.5 * held
    assert second > 0.4 * first  # the first run loaded the kernels too
