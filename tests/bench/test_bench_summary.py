from __future__ import annotations

import statistics

import pytest
from bench_fixtures import make_bench

from skipgs_plug.bench.find import known_policies
from skipgs_plug.bench.plots import style
from skipgs_plug.bench.record import REASON_CODES, Point, RunRecord, Trace
from skipgs_plug.bench.summary import Row, ceiling, row_as_dict, row_from_dict, summarise, time_to_reach, timing_noise
from skipgs_plug.bench.table import REFINEMENT, SHARES, cells, legend, markdown, metric_columns, notes, tables
from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision
from skipgs_plug.trainer.metrics import METRICS, Metric

T_DENSIFY = 10.0


def record(policy: str, seed: int, t_post: float, backwards: int = 100, psnr: float = 20.0) -> RunRecord:
    seconds = dict.fromkeys(("t_post", "t_post_processor"), t_post)
    seconds.update(dict.fromkeys(("t_total", "t_total_processor"), T_DENSIFY + t_post))
    phases = {"forward": 0.4 * t_post, "loss": 0.1 * t_post, "backward": 0.4 * t_post, "optimizer": 0.1 * t_post}
    return RunRecord(
        seed, policy, iterations=100, iterations_run=100, backwards=backwards, t_post=t_post,
        t_total=T_DENSIFY + t_post, seconds=seconds, phases={**phases, "strategy": 0.0},
        metrics={"psnr": psnr, "ssim": 0.5, "num_GS": 10}, train_metrics={"psnr": psnr + 2, "ssim": 0.6},
        points=[Point(0, 0.0, {"psnr": 19.0}), Point(100, t_post, {"psnr": psnr})],
        trace=Trace(0, [0], [0.1], [None], "w"),
    )  # fmt: skip


def test_means_spreads_and_differences_within_each_seed():
    records = [
        record("own", 0, 10.0, psnr=20.0),
        record("own", 1, 20.0, psnr=22.0),
        record("gate", 0, 8.0, 60, psnr=19.5),
        record("gate", 1, 10.0, 50, psnr=22.1),
    ]
    own, gate = summarise(records, ("own", "gate"), 100)
    assert own.values["t_post"].mean == 15.0
    assert own.values["t_post"].spread == statistics.stdev([10.0, 20.0])
    assert gate.values["t_post_saved"].mean == pytest.approx((20 + 50) / 2)
    assert gate.values["t_total_saved"].mean == pytest.approx(100 * (2 / 20 + 10 / 30) / 2)
    assert gate.values["psnr_gain"].mean == pytest.approx((-0.5 + 0.1) / 2)
    assert gate.values["train_psnr"].mean == pytest.approx(22.8)
    assert "train_num_GS" not in gate.values
    assert gate.values["backwards_share"].mean == 55.0
    assert gate.values["share_backward"].mean == pytest.approx(40.0)


def test_time_to_reach_is_interpolated_at_the_first_crossing():
    points = [Point(10 * i, 2.0 * i, {"psnr": psnr}) for i, psnr in enumerate((20.0, 21.0, 20.5, 23.0))]
    assert time_to_reach(points, 20.25) == pytest.approx(0.5)
    assert time_to_reach(points, 22.0) == pytest.approx(4 + 2 * 1.5 / 2.5)
    assert time_to_reach(points, 23.0) == 6.0
    assert time_to_reach(points, 23.1) is None
    assert time_to_reach(points, 20.0) == time_to_reach(points, 19.0) == 0.0


def test_time_to_own_says_where_it_is_not_reached():
    records = [record("own", seed, 10.0, psnr=20.0) for seed in (0, 1)]
    records += [record("gate", 0, 8.0, psnr=21.0), record("gate", 1, 8.0, psnr=19.9)]
    records += [record("random", seed, 8.0, psnr=19.5) for seed in (0, 1)]
    heading, own, gate, chance = cells(summarise(records, ("own", "gate", "random"), 100), REFINEMENT)
    column = heading.index("s to own PSNR")
    assert own[column] == "10.0 ± 0.0"
    assert gate[column] == "4.0 (1 of 2)"  # half of the way from 19 to 21 dB
    assert chance[column] == "not reached"


def test_ceiling_is_backward_and_optimizer_share_times_skip_rate():
    rows = summarise([record("own", 0, 10.0), record("gate", 0, 8.0, 60)], ("own", "gate"), 100)
    most = ceiling(rows)
    assert most == pytest.approx({"share": 50.0, "skipped": 40.0, "most": 20.0, "measured": 20.0})
    assert ceiling(rows[:1]) is None


def test_timing_noise_compares_forward_passes_within_a_seed():
    assert timing_noise([record("own", 0, 10.0), record("gate", 1, 12.0)]) is None
    records = [record("own", 0, 10.0), record("gate", 0, 12.0), record("own", 1, 99.0)]
    assert timing_noise(records) == pytest.approx(20.0)


def test_a_diverged_seed_is_left_out_visibly():
    lost = RunRecord(1, "gate", "diverged", "loss nan at iteration 7 on view a.png")
    records = [record("own", 0, 10.0), record("own", 1, 10.0), record("gate", 0, 8.0, 60), lost]
    rows = summarise(records, ("own", "gate"), 100)
    assert rows[1].seeds == [0] and rows[1].values["t_post"].mean == 8.0
    line = cells(rows, REFINEMENT)[2]
    assert line[:2] == ["gate", "1 of 2 !"]
    assert "Seed 1 of gate is left out of its means: diverged: loss nan at iteration 7 on view a.png." in notes(
        rows, result_of(rows)
    )


def test_a_policy_without_any_finished_seed_keeps_its_row():
    rows = summarise([record("own", 0, 1.0), RunRecord(0, "gate", "diverged", "x")], ("own", "gate"), 100)
    assert cells(rows, REFINEMENT)[2][:3] == ["gate", "0 of 1 !", "-"]


def test_one_seed_has_no_spread_and_absent_columns_are_left_out():
    rows = summarise([record("own", 0, 10.0)], ("own",), 100)
    heading, line = cells(rows, REFINEMENT)
    assert line[heading.index("T_post s")] == "10.0"
    assert not any("LPIPS" in name for name in heading)
    assert cells(rows, SHARES) == [
        ["policy", "seeds", "forward", "loss", "backward", "optimizer"],
        ["own", "1", "40.0", "10.0", "40.0", "10.0"],
    ]


def test_tables_without_a_column_are_left_out():
    rows = summarise([record("own", 0, 10.0)], ("own",), 100)
    assert [caption.split()[0] for caption, _ in tables(rows)] == ["Time", "Quality", "Share"]
    del rows[0].values["train_psnr"], rows[0].values["train_ssim"]
    assert [caption.split()[0] for caption, _ in tables(rows)] == ["Time", "Share"]


def test_a_row_of_a_policy_that_this_version_lacks_is_shown():
    rows = [Row("gone", [0])]
    assert legend(rows) == [("gone", "a policy of another version")]
    assert style("gone") == style("gone") and cells(rows, REFINEMENT) == [["policy", "seeds"], ["gone", "1"]]


def test_every_policy_looks_different():
    for whole in (False, True):
        names = known_policies(whole)
        assert len({style(name, whole) for name in names}) == len(names)


def test_a_new_metric_is_one_entry(scene, tmp_path, monkeypatch):
    worst = Metric(
        "worst", "Worst pixel", 3, "greatest difference", lambda a, b, mask: float((a - b).abs().max()), unit="%"
    )
    monkeypatch.setitem(METRICS, "worst", worst)
    bench = make_bench(scene, tmp_path, seeds=(0,), policies=("own",), max_steps=20, tensorboard=True)
    (done,) = bench.run()
    assert 0 < done.metrics["worst"] < 3 and "worst" in done.train_metrics and "worst" in done.points[3].metrics
    rows = summarise([done], ("own",), 10)
    assert rows[0].values["worst_gain"].mean == 0.0
    assert [column.name for column in metric_columns(worst)] == ["worst", "worst_gain"]
    assert "Worst pixel: greatest difference." in " ".join(notes(rows, result_of(rows)))


@pytest.mark.parametrize("reason", [value.reason for value in vars(decision).values() if isinstance(value, Decision)])
def test_every_reason_of_the_gate_has_a_letter(reason):
    assert reason in REASON_CODES


def test_an_unknown_reason_has_a_letter_too():
    trace = Trace(5)
    trace.add(0, 0.1, None, "intuition", skip=True)
    trace.fill(8)
    trace.add(2, 0.1, None, "intuition", skip=False)
    assert trace.codes == "U..u" and trace.view == [0, None, None, 2] and trace.end == 9
    assert trace.skipped == [True, False, False, False] and trace.ran == [True, False, False, True]


def test_markdown_is_aligned():
    text = markdown([["policy", "x"], ["a", "1.0"], ["longer name", "12 ± 3"]]).splitlines()
    assert len({len(line) for line in text}) == 1 and len(text) == 4
    assert text[1] == "| ----------- | -----: |"


def test_rows_survive_json():
    rows = summarise([record("own", 0, 10.0), RunRecord(1, "own", "diverged", "x")], ("own",), 100)
    assert row_from_dict(row_as_dict(rows[0])) == rows[0]


def result_of(rows):
    scene = {
        "name": "s",
        "image_sizes": ["4x4"],
        "images": "as found",
        "split": "as packed",
        "train_views": 1,
        "test_views": 1,
    }
    machine = {"backend": "warp", "gpu": None, "cpu": "some processor", "threads": 2}
    return {
        "ceiling": ceiling(rows),
        "timing_noise": None,
        "settings": {"scene": scene, "machine": machine, "lpips": None},
        "refinement": [50, 100],
        "runs": [],
        "commits": ["abc"],
    }
