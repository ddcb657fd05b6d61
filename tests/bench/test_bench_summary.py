from __future__ import annotations

import statistics

import pytest

from skipgs_plug.bench.record import Point, RunRecord, Trace
from skipgs_plug.bench.summary import ceiling, row_as_dict, row_from_dict, summarise, timing_noise
from skipgs_plug.bench.table import RESULTS, SHARES, cells, markdown, notes

T_DENSIFY = 10.0


def record(policy: str, seed: int, t_post: float, backwards: int = 100, psnr: float = 20.0) -> RunRecord:
    phases = {"forward": 0.4 * t_post, "loss": 0.1 * t_post, "backward": 0.4 * t_post, "optimizer": 0.1 * t_post}
    return RunRecord(
        seed, policy, iterations=100, backwards=backwards, t_post=t_post, t_total=T_DENSIFY + t_post,
        phases={**phases, "strategy": 0.0}, metrics={"psnr": psnr, "ssim": 0.5, "num_GS": 10},
        points=[Point(0, 0.0, 19.0, 0.4)], trace=Trace(0, [0], [0.1], [None], "w"),
    )  # fmt: skip


def test_means_spreads_and_differences_within_each_seed():
    records = [
        record("ungated", 0, 10.0, psnr=20.0),
        record("ungated", 1, 20.0, psnr=22.0),
        record("gate", 0, 8.0, 60, psnr=19.5),
        record("gate", 1, 10.0, 50, psnr=22.1),
    ]
    ungated, gate = summarise(records, ("ungated", "gate"), 100)
    assert ungated.values["t_post"].mean == 15.0
    assert ungated.values["t_post"].spread == statistics.stdev([10.0, 20.0])
    assert gate.values["t_post_saved"].mean == pytest.approx((20 + 50) / 2)
    assert gate.values["t_total_saved"].mean == pytest.approx(100 * (2 / 20 + 10 / 30) / 2)
    assert gate.values["psnr_gain"].mean == pytest.approx((-0.5 + 0.1) / 2)
    assert gate.values["backwards_share"].mean == 55.0
    assert gate.values["share_backward"].mean == pytest.approx(40.0)


def test_ceiling_is_backward_and_optimizer_share_times_skip_rate():
    rows = summarise([record("ungated", 0, 10.0), record("gate", 0, 8.0, 60)], ("ungated", "gate"), 100)
    most = ceiling(rows)
    assert most == pytest.approx({"share": 50.0, "skipped": 40.0, "most": 20.0, "measured": 20.0})
    assert ceiling(rows[:1]) is None


def test_timing_noise_compares_forward_passes_within_a_seed():
    assert timing_noise([record("ungated", 0, 10.0), record("gate", 1, 12.0)]) is None
    records = [record("ungated", 0, 10.0), record("gate", 0, 12.0), record("ungated", 1, 99.0)]
    assert timing_noise(records) == pytest.approx(20.0)


def test_a_diverged_seed_is_left_out_visibly():
    lost = RunRecord(1, "gate", "diverged", "loss nan at iteration 7 on view a.png")
    records = [record("ungated", 0, 10.0), record("ungated", 1, 10.0), record("gate", 0, 8.0, 60), lost]
    rows = summarise(records, ("ungated", "gate"), 100)
    assert rows[1].seeds == [0] and rows[1].values["t_post"].mean == 8.0
    line = cells(rows, RESULTS)[2]
    assert line[:2] == ["gate", "1 of 2 !"]
    assert "Seed 1 of gate is left out of its means: diverged: loss nan at iteration 7 on view a.png." in notes(
        rows, result_of(rows)
    )


def test_a_policy_without_any_finished_seed_keeps_its_row():
    rows = summarise([record("ungated", 0, 1.0), RunRecord(0, "gate", "diverged", "x")], ("ungated", "gate"), 100)
    assert cells(rows, RESULTS)[2][:3] == ["gate", "0 of 1 !", "-"]


def test_one_seed_has_no_spread_and_absent_columns_are_left_out():
    rows = summarise([record("ungated", 0, 10.0)], ("ungated",), 100)
    heading, line = cells(rows, RESULTS)
    assert line[heading.index("T_post s")] == "10.0"
    assert not any("LPIPS" in name for name in heading)
    assert cells(rows, SHARES) == [
        ["policy", "seeds", "forward", "loss", "backward", "optimizer"],
        ["ungated", "1", "40.0", "10.0", "40.0", "10.0"],
    ]


def test_markdown_is_aligned():
    text = markdown([["policy", "x"], ["a", "1.0"], ["longer name", "12 ± 3"]]).splitlines()
    assert len({len(line) for line in text}) == 1 and len(text) == 4
    assert text[1] == "| ----------- | -----: |"


def test_rows_survive_json():
    rows = summarise([record("ungated", 0, 10.0), RunRecord(1, "ungated", "diverged", "x")], ("ungated",), 100)
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
        "commits": ["abc"],
    }
