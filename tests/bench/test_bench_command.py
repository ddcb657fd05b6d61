from __future__ import annotations

import json

import numpy as np
import pytest

from skipgs_plug.bench.plots import NOT_VISITED, RUN, SKIPPED, visit_map, write_plots
from skipgs_plug.bench.record import Trace
from skipgs_plug.bench.summary import summarise
from skipgs_plug.cli import main
from skipgs_plug.trainer import save_packed

PLOTS = ("psnr_over_time", "time_against_error", "phases", "skipped_views", "loss_and_mean")


@pytest.fixture(scope="module")
def packed(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("packed") / "tiny.npz"
    save_packed(scene, path)
    return str(path)


def bench(packed: str, out, *more: str) -> int:
    arguments = ["bench", packed, "--out", str(out), "--max-steps", "40", "--seeds", "3", "--no-progress", *more]
    return main(arguments)


def test_command_prints_the_table_and_leaves_json_and_plots(packed, tmp_path, capsys):
    out = tmp_path / "out"
    assert bench(packed, out, "--policies", "own", "gate", "random") == 0
    printed = capsys.readouterr().out
    for name in ("own", "gate", "random"):
        assert f"| {name} " in printed
    assert "20 to 40" in printed and "6 training and 2 held-out views" in printed
    assert (out / "table.md").read_text() in printed
    result = json.loads((out / "bench.json").read_text())
    assert result["command"].startswith("skipgs-plug bench ") and result["seeds"] == [3]
    assert result["settings"]["machine"]["cores"] >= 1 and result["versions"]["torch"]
    assert len(result["runs"]) == 3 and "trace" not in result["runs"][0]
    assert len(result["view_names"]) == 6
    for name in PLOTS:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--policies", "gatee"), "There is no policy 'gatee'"),
        (("--policies",), "--policies is empty"),
        (("--policies", "random", "own"), "add gate to --policies"),
        (("--seeds", "1", "1"), "each once"),
        (("--max-steps", "1"), "nothing to refine"),
    ],
)
def test_bad_input_is_one_sentence(packed, tmp_path, capsys, more, sentence):
    assert bench(packed, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err.strip()
    assert sentence in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_plots_are_drawn_from_whatever_finished(finished, tmp_path):
    records = [finished.run("own", 0)]
    rows = summarise(records, ("own",), 40)
    names = [view.name for view in finished.bench.scene.train]
    write_plots(tmp_path, records, rows, names)
    assert {path.stem for path in tmp_path.iterdir()} == {"psnr_over_time", "time_against_error", "phases"}


def test_names_of_views_are_no_formulas(finished, tmp_path):
    records = [finished.run("gate", 0)]
    names = [rf"$\frac$ {view.name}" for view in finished.bench.scene.train]
    write_plots(tmp_path, records, summarise(records, ("gate",), 40), names)
    assert (tmp_path / "loss_and_mean.png").is_file()


def test_visit_map_has_a_column_for_each_epoch():
    # There are three views, so epochs are iterations 3 to 5 and 6 to 8. Refinement begins at 4.
    trace = Trace(start=4, view=[2, 0, 1, 2, 0], loss=[0.0] * 5, mean=[None] * 5, codes="wdDDd")
    assert np.array_equal(visit_map(trace, 3), [[RUN, RUN], [NOT_VISITED, SKIPPED], [RUN, SKIPPED]])
