from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import pytest
import torch
from bench_fixtures import MAX_STEPS, SEEDS, early_floor, make_bench

from skipgs_plug.bench import provenance, runner
from skipgs_plug.bench.policies import POLICIES, RefineBenchPolicy
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.refine import PARTS, compressed, densify, peak_memory
from skipgs_plug.bench.store import BenchFolder
from skipgs_plug.bench.summary import summarise
from skipgs_plug.fallback_raster import get_num_threads, set_num_threads
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.backend import resolve_backend

START = MAX_STEPS // 2


def test_threads_are_those_that_render():
    before = get_num_threads()
    set_num_threads(before + 3)
    try:
        assert provenance.machine(resolve_backend("warp"))["threads"] == before + 3
    finally:
        set_num_threads(before)


def test_every_policy_ran_from_the_same_point(finished):
    for seed in SEEDS:
        starts = {finished.run(policy, seed).points[0].metrics["psnr"] for policy in POLICIES}
        assert len(starts) == 1
        densified = {finished.run(policy, seed).t_total - finished.run(policy, seed).t_post for policy in POLICIES}
        assert max(densified) - min(densified) < 1e-9


def test_every_policy_saw_the_same_views_in_the_same_order(finished):
    for seed in SEEDS:
        full = finished.run("own", seed).trace.view
        assert len(full) == MAX_STEPS - START
        for policy in POLICIES:
            record = finished.run(policy, seed)
            assert record.trace.start == START
            seen = [view for view in record.trace.view if view is not None]
            assert seen == full[: record.iterations_run]  # views take turns among the iterations that run
            assert len(record.trace.view) == record.iterations
    assert finished.run("own", 0).trace.view != finished.run("own", 1).trace.view


def test_controls_skip_exactly_as_often_as_the_gate(finished):
    for seed in SEEDS:
        gate = finished.run("gate", seed)
        assert 0 < gate.skips < gate.iterations - gate.warm_up
        assert gate.warm_up == 2 * len(finished.bench.scene.train)
        for policy in ("random", "periodic"):
            control = finished.run(policy, seed)
            assert control.skips == gate.skips
            assert sum(control.trace.skipped) == gate.skips
            assert not any(control.trace.skipped[: gate.warm_up])
            assert control.trace.skipped != gate.trace.skipped


def test_what_the_rule_asked_for_is_told_from_what_the_floor_forbade(finished):
    record = finished.run("gate")
    row = next(row for row in summarise([record], ("gate",), record.iterations))
    after = record.trace.codes[record.warm_up :]
    assert row.values["wanted"].mean == pytest.approx(100 * after.count("d") / len(after))
    assert row.values["held_back"].mean == pytest.approx(100 * after.count("b") / len(after))
    assert after.count("b") > 0


def test_own_runs_every_backward(finished):
    record = finished.run("own")
    assert record.backwards == record.iterations_run == record.iterations == MAX_STEPS - START
    assert set(record.trace.codes) == {"-"}


def test_a_gate_skips_at_or_below_the_mean_only(finished):
    trace = finished.run("gate").trace
    for loss, mean, code in zip(trace.loss, trace.mean, trace.codes, strict=True):
        if code == "D":
            assert mean is not None and loss <= mean
        elif code == "d":
            assert loss >= mean


def test_time_is_split_into_phases_and_evaluated_on_the_way(finished):
    for record in finished.records:
        assert sum(record.phases.values()) == pytest.approx(record.t_post, rel=1e-6)
        steps = [point.step for point in record.points]
        assert steps[0] == START and steps[-1] == START + record.iterations
        seconds = [point.seconds for point in record.points]
        assert seconds == sorted(seconds) and seconds[0] == 0.0
        assert record.points[-1].metrics["psnr"] == record.metrics["psnr"]
        assert len(record.points) == 1 + PARTS and "num_GS" not in record.points[0].metrics
        assert record.train_metrics["psnr"] != record.metrics["psnr"]


def test_policies_take_turns(scene, tmp_path, monkeypatch):
    seen = []
    train = Trainer.train

    def noted(trainer, until=None, progress=True):
        seen.append((id(trainer), until))
        train(trainer, until, progress)

    monkeypatch.setattr(Trainer, "train", noted)
    make_bench(scene, tmp_path, seeds=(0,), policies=("own", "gate")).run()
    parts = seen[1:]  # after densification
    assert [until for _, until in parts] == [START + 4 * part for part in range(1, PARTS + 1) for _ in range(2)]
    assert [owner for owner, _ in parts] == [parts[0][0], parts[1][0]] * PARTS and parts[0][0] != parts[1][0]


def test_a_run_in_turns_equals_one_alone(scene, finished, tmp_path):
    with early_floor():
        (alone,) = make_bench(scene, tmp_path, seeds=(0,), policies=("gate,min_bwd_ratio=0",)).run()
    together = finished.run("gate,min_bwd_ratio=0")
    assert alone.trace == together.trace and alone.metrics == together.metrics


def test_peak_memory_is_that_of_the_run_alone(monkeypatch):
    parameter = torch.nn.Parameter(torch.zeros(100))
    optimizer = torch.optim.Adam([parameter])
    parameter.sum().backward()
    optimizer.step()
    own = parameter.nbytes + sum(tensor.nbytes for tensor in optimizer.state[parameter].values())
    trainer = SimpleNamespace(
        backend=SimpleNamespace(device=torch.device("cuda")),
        splats={"means": parameter},
        optimizers={"means": optimizer},
    )
    record = RunRecord(0, "gate")
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: None)
    for others, peak in (
        (50_000, 57_000),
        (90_000, 93_000),
    ):  # memory that all runs hold, and the peak during this part
        monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device, held=others: held)
        monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device, most=peak: most)
        with peak_memory(trainer, record):
            pass
    assert record.peak_memory == 7_000 + own and own >= 3 * 400


def test_a_policy_that_leaves_out_whole_iterations_is_one_entry(scene, tmp_path, monkeypatch):
    def every_second(trainer, earlier):
        trainer.iterations = lambda until: [n for n in range(trainer.step, until) if n % 2 == 0]

    monkeypatch.setitem(POLICIES, "halved", RefineBenchPolicy("halved", "every second iteration", gate=every_second))
    full, record = make_bench(scene, tmp_path, seeds=(0,), policies=("own", "halved")).run()
    assert (record.iterations, record.iterations_run, record.backwards, record.skips) == (40, 20, 20, 0)
    assert record.trace.codes == "-." * 20
    assert all(
        (view is None) == (loss is None) == (i % 2 == 1)
        for i, (view, loss) in enumerate(zip(record.trace.view, record.trace.loss, strict=True))
    )
    assert 0.0 < record.t_post < full.t_post
    row = summarise([full, record], ("own", "halved"), 40)[1]
    assert row.values["iterations_run"].mean == 20 and row.values["backwards_share"].mean == 50.0


def test_shortened_runs_through_the_whole_schedule(scene):
    trainer = Trainer(TrainConfig(max_steps=200, sh_degree_interval=7000), scene)

    def rate(step: int) -> float:
        trainer.set_learning_rate(step)
        return trainer.optimizers["means"].param_groups[0]["lr"]

    full = [rate(step) for step in (50, 100, 150, 200)]
    degrees = [trainer.active_sh_degree(step) for step in (100, 150, 199)]
    with compressed(trainer, start=100, iterations=50):
        assert [rate(step) for step in (50, 100, 125, 150)] == pytest.approx(full)
        assert [trainer.active_sh_degree(step) for step in (100, 125, 149)] == degrees
    assert rate(150) == pytest.approx(full[2])


def test_a_killed_bench_continues_where_it_stopped(scene, finished, tmp_path):
    class Killed(BaseException):
        pass

    lines: list[str] = []

    def die_after_three(line: str) -> None:
        lines.append(line)
        if len(lines) == 4:  # one line of densification, then three of runs
            raise Killed

    with early_floor(), pytest.raises(Killed):
        make_bench(scene, tmp_path, say=die_after_three).run()
    stored = {path: path.read_bytes() for path in (tmp_path / "runs").iterdir()}
    assert len(stored) == 3

    said: list[str] = []
    with early_floor():
        records = make_bench(scene, tmp_path, say=said.append).run()
    assert sum("continuing from its snapshot" in line for line in said) == 1
    assert len(records) == len(SEEDS) * len(POLICIES)
    assert sum("T_post" in line for line in said) == len(records) - 3
    assert all(path.read_bytes() == content for path, content in stored.items())
    for record in records:
        if not record.policy.startswith("shortened"):  # its length depends on measured time
            whole = finished.run(record.policy, record.seed)
            assert record.trace == whole.trace
            assert record.metrics == whole.metrics

    said.clear()
    assert make_bench(scene, tmp_path, say=said.append).run() == records
    assert said == []


def test_a_run_that_diverges_is_named_and_its_copies_are_not_run(scene, tmp_path):
    bench = make_bench(scene, tmp_path, seeds=(5,))
    turn = 1 + (MAX_STEPS - START) // PARTS  # one iteration compiles, and a part has the others
    bench.backend = failing_backend(
        1 + START + turn + 1 + 3
    )  # densification, the own run's turn, the gate's third loss
    found = {record.policy: record for record in bench.run()}
    assert found["own"].status == "done"
    assert found["gate"].status == "diverged"
    assert f"loss nan at iteration {START + 2} on view" in found["gate"].note
    assert found["gate,min_bwd_ratio=0"].status == "done"
    for policy in ("random", "periodic", "shortened"):
        assert found[policy].status == "not run" and "gate" in found[policy].note
    assert json.loads((tmp_path / "runs" / "seed5_gate.json").read_text())["status"] == "diverged"


def test_a_seed_that_diverges_in_densification_is_named_under_every_policy(scene, tmp_path):
    bench = make_bench(scene, tmp_path, seeds=(5,), policies=("own", "gate"))
    bench.backend = failing_backend(10)
    records = bench.run()
    assert [record.status for record in records] == ["diverged", "diverged"]
    assert all("densification" in record.note for record in records)


def failing_backend(call: int):
    """Return the default backend with a loss that is NaN at its `call`-th evaluation."""
    backend = resolve_backend("auto")
    calls = 0

    def loss(image: torch.Tensor, target: torch.Tensor, ssim_lambda: float) -> torch.Tensor:
        nonlocal calls
        calls += 1
        value = backend.loss(image, target, ssim_lambda)
        return value * float("nan") if calls == call else value

    return dataclasses.replace(backend, loss=loss)


def test_other_settings_in_the_same_folder_are_refused(scene, finished):
    with pytest.raises(InputError, match=r"training.max_steps=80, not 90"):
        make_bench(scene, finished.folder, max_steps=90)


def test_the_folder_of_a_training_run_is_refused(scene, tmp_path):
    (tmp_path / "skipgs.json").write_text("{}")
    with pytest.raises(InputError, match=r"holds a training run \(.*skipgs.json\), not a bench; give another --out"):
        make_bench(scene, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["skipgs.json"]


def test_more_seeds_may_be_added_to_a_folder(scene, finished):
    make_bench(scene, finished.folder, seeds=(0, 1, 2))


def test_a_scene_without_held_out_views_is_refused(scene, tmp_path):
    bare: Scene = dataclasses.replace(scene, test=[])
    with pytest.raises(InputError, match="no held-out views"):
        make_bench(bare, tmp_path)


def test_a_schedule_without_refinement_is_refused(scene, tmp_path):
    config = TrainConfig(max_steps=100, refine_stop_iter=30_000)
    bench = make_bench(scene, tmp_path)
    with pytest.raises(InputError, match="nothing to refine"):
        type(bench)(scene, config, bench.folder, (0,), ("own",))


def test_a_damaged_run_is_named(scene, finished, tmp_path):
    bench = make_bench(scene, tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "seed0_gate.json").write_text("{")
    with pytest.raises(InputError, match=r"seed0_gate\.json"):
        bench.run()


def test_densify_stops_where_refinement_begins(scene):
    trainer = Trainer(TrainConfig(max_steps=20), scene)
    densify(trainer, progress=False)
    assert trainer.step == trainer.refine_stop_iter == 10


def test_processor_time_is_for_the_cpu(monkeypatch, tmp_path, scene):
    monkeypatch.setattr(runner, "resolve_backend", lambda name: SimpleNamespace(device=torch.device("cuda")))
    with pytest.raises(InputError, match="do not include the work of a GPU"):
        runner.Bench(scene, TrainConfig(max_steps=40), BenchFolder(tmp_path), [0], ["own"], clock="processor")
