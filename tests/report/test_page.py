from __future__ import annotations

import dataclasses
import json
import re
import shutil

import pytest
from browser import Browser
from report_browser import body_count

from skipgs_plug import SkipGSError
from skipgs_plug.cli import main
from skipgs_plug.report.phases import phases
from skipgs_plug.report.plots import inline_svg, loss_over_time
from skipgs_plug.report.source import read_source
from skipgs_plug.trainer import TrainConfig, Trainer, load_scene, save_packed
from skipgs_plug.trainer.curve import LossCurve


def make_page(tmp_path, *folders):
    page = tmp_path / "page.html"
    assert main(["report", *map(str, folders), "--out", str(page)]) == 0
    return page


def rows_of(dom: str, caption: str) -> list[list[str]]:
    """Return the cells of the body rows of the table with this caption."""
    table = re.search(rf"<table[^>]*><caption>{re.escape(caption)}.*?</table>", dom, re.DOTALL)
    assert table, f"no table {caption!r}"
    body = table.group(0).split("<tbody>")[1]
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>.*?</tr>", body, re.DOTALL)]


def test_browser_shows_a_training_run(train_folder, tmp_path, dump_dom):
    dom = dump_dom(make_page(tmp_path, train_folder))
    data = json.loads((train_folder / "skipgs.json").read_text())
    (row,) = rows_of(dom, "Decisions of the gate")
    assert row[:5] == ["gated", "40", "20", str(data["backwards_run"]), str(data["backwards_skipped"])]
    assert len(rows_of(dom, "Training views")) == 6
    assert dict(rows_of(dom, "Last evaluation"))["num_GS"].isdigit()
    # Loss, Gaussians, quality of views, three plots of the gate; photograph, render and error of two held-out views.
    assert body_count(dom, "images") == body_count(dom, "decoded") == 6 + 6


def test_a_run_without_a_gate_is_shown_with_its_worst_view_first(ungated_folder, tmp_path, dump_dom):
    dom = dump_dom(make_page(tmp_path, ungated_folder))
    stats = json.loads((ungated_folder / "stats/val_step39.json").read_text())
    worst, best = sorted(stats["per_view"], key=lambda row: row["psnr"])
    results = dict(rows_of(dom, "Results"))
    assert results["held-out PSNR, dB"] == f"{stats['psnr']:.2f}"
    assert results["worst view, dB"] == f"{worst['psnr']:.2f}"
    assert results["backwards skipped, %"] == "-"
    assert results["training, s"] == f"{stats['t_total']:.1f}" and stats["t_total"] > 0
    assert results["after densification, s"] == f"{stats['t_post']:.1f}"
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", dom)
    first, second = (
        captions.index(caption) for caption in captions if "held-out views." in caption and "dB" in caption
    )
    assert captions[first].startswith(f"{worst['view']}: {worst['psnr']:.2f} dB, worst of 2")
    assert captions[second].startswith(best["view"])
    assert "Decisions of the gate" not in dom
    assert body_count(dom, "images") == body_count(dom, "decoded") == 3 + 6


def test_a_run_that_holds_out_no_view_is_shown_with_its_training_views(scene_file, ungated_folder, tmp_path):
    folder, packed, scene = tmp_path / "all", tmp_path / "all.npz", load_scene(scene_file)
    save_packed(dataclasses.replace(scene, train=scene.train + scene.test, test=[]), packed)
    assert main(["train", str(packed), "--out", str(folder), "--max-steps", "4", "--no-progress"]) == 0
    page = make_page(tmp_path, folder).read_text(encoding="utf-8")
    stats = json.loads((folder / "stats/train_step3.json").read_text())
    results = dict(rows_of(page, "Results"))
    assert results["training PSNR, dB"] == f"{stats['psnr']:.2f}" and results["held-out PSNR, dB"] == "-"
    assert results["Gaussians"] == f"{stats['num_GS']:,}"
    assert len(rows_of(page, "Evaluated views")) == stats["views"]
    assert f"worst of {stats['views']} training views." in page
    both = rows_of(make_page(tmp_path, folder, ungated_folder).read_text(encoding="utf-8"), "All runs")
    assert [row.count("-") for row in both[:2]] == [1, 1]  # each run has its own kind of PSNR


def test_pages_fit_a_phone(train_folder, bench_folder, script_folder, tmp_path):
    page = make_page(tmp_path, train_folder, bench_folder, script_folder)
    with Browser(tmp_path / "profile", width=390, height=844) as browser:
        browser.open(page.as_uri())
        assert browser.evaluate("document.documentElement.scrollWidth") == 390
        widths = browser.evaluate("[...document.querySelectorAll('figure')].map(f => f.getBoundingClientRect().right)")
        assert len(widths) > 10 and max(widths) <= 390
        sizes = browser.evaluate(
            "[...document.querySelectorAll('td')].map(c => parseFloat(getComputedStyle(c).fontSize))"
        )
        assert min(sizes) >= 13


def test_the_curve_of_a_run_goes_on_after_a_resume(scene_file, tmp_path):
    scene = load_scene(scene_file)
    whole, first, second = (Trainer(TrainConfig(max_steps=1200), scene) for _ in range(3))
    curves = [LossCurve(trainer) for trainer in (whole, first, second)]
    for trainer, curve in zip((whole, first, second), curves, strict=True):
        trainer.on_step = curve.iteration
    whole.train(until=21, progress=False)
    first.train(until=11, progress=False)
    second.restore(first.snapshot())
    second.train(until=21, progress=False)
    curves[0].write(tmp_path / "whole.json")
    curves[2].write(tmp_path / "resumed.json")
    contents = [json.loads((tmp_path / name).read_text()) for name in ("whole.json", "resumed.json")]
    assert contents[0]["step"] == list(range(1, 21, 2)) and len(contents[0]["loss"]) == 10
    for name in ("step", "loss", "num_GS"):
        assert contents[0][name] == contents[1][name]
    assert contents[1]["seconds"] == sorted(contents[1]["seconds"])


def test_browser_shows_a_bench(bench_folder, tmp_path, dump_dom):
    dom = dump_dom(make_page(tmp_path, bench_folder))
    rows = rows_of(dom, "Time and quality")
    assert [row[0] for row in rows] == ["own", "gate", "random"]
    assert all(len(row) == len(rows[0]) > 8 for row in rows)
    assert [row[0] for row in rows_of(dom, "Share of refinement time")] == ["own", "gate", "random"]
    assert "A perfect gate at this skip rate could save" in dom
    assert "Share of backward passes skipped during refinement" in dom
    assert body_count(dom, "images") == body_count(dom, "decoded") == 6


def test_browser_shows_the_run_of_an_upstream_script(script_folder, tmp_path, dump_dom):
    dom = dump_dom(make_page(tmp_path, script_folder))
    (row,) = rows_of(dom, "Decisions of the gate")
    assert row[:3] == ["output &amp; &lt;model&gt;", "60", "55"]
    assert [row[0] for row in rows_of(dom, "Training views")] == [f"cam/{i}&lt;b&gt;.png" for i in range(3)]
    assert body_count(dom, "images") == body_count(dom, "decoded") == 3


def test_settings_that_differ_stand_beside_the_comparison(ungated_folder, script_folder, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(ungated_folder, other)
    settings = (other / "cfg.yml").read_text()
    assert "\nschedule_steps: 40\n" in settings  # as after a resume, which makes no difference
    (other / "cfg.yml").write_text(settings.replace("data_factor: 1", "data_factor: 4") + "newer: 1\n")
    page = make_page(tmp_path, ungated_folder, other, script_folder).read_text()
    assert rows_of(page, "Settings that differ") == [["data_factor", "1", "4", "-"]]
    assert "Settings that differ" not in make_page(tmp_path, ungated_folder, ungated_folder).read_text()


def test_browser_compares_several_runs(train_folder, ungated_folder, script_folder, bench_folder, tmp_path, dump_dom):
    dom = dump_dom(make_page(tmp_path, train_folder, ungated_folder, script_folder, bench_folder))
    table = dom[dom.index("All runs") :]
    names = re.findall(r'<th scope="col">(.*?)</th>', table[: table.index("</thead>")])
    assert names == ["", "gated", "ungated", "output &amp; &lt;model&gt;"]
    rows = {row[0]: row[1:] for row in rows_of(dom, "All runs")}
    expected = [json.loads((f / "stats/val_step39.json").read_text()) for f in (train_folder, ungated_folder)]
    assert rows["SSIM"] == [*(f"{stats['ssim']:.4f}" for stats in expected), "-"]
    assert rows["Gaussians"] == [*(f"{stats['num_GS']:,}" for stats in expected), "-"]
    # Three pictures of the comparison, then those of each run and of the bench.
    assert body_count(dom, "images") == body_count(dom, "decoded") == 3 + 12 + 9 + 3 + 6


def test_runs_of_one_name_are_told_apart_by_their_paths(ungated_folder, tmp_path):
    copy = tmp_path / "ungated"
    shutil.copytree(ungated_folder, copy)
    text = make_page(tmp_path, ungated_folder, copy).read_text()
    assert f">{ungated_folder}<" in text and f">{copy}<" in text


def test_a_run_that_is_given_twice_is_shown_once(ungated_folder, tmp_path):
    text = make_page(tmp_path, ungated_folder, f"{ungated_folder}/").read_text()
    assert text.count("<table") == make_page(tmp_path, ungated_folder).read_text().count("<table")


@pytest.mark.parametrize("name", ["_run", "a$^$", "\u732b"])
def test_every_name_is_in_the_legend(name):
    """matplotlib hides names that begin with _, reads formulas, and warns of letters that its font lacks."""
    curve = {"step": [0, 9], "loss": [0.5, 0.1]}
    figure = loss_over_time({name: curve, "other": curve})
    inline_svg(figure)
    assert len(figure.legends[0].get_texts()) == 2


def test_page_loads_nothing_from_elsewhere(train_folder, bench_folder, tmp_path):
    text = make_page(tmp_path, train_folder, bench_folder).read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert sources and all(source.startswith("data:") for source in sources)
    assert "<script" not in text and "url(" not in text and "@import" not in text


def test_tables_and_pictures_are_accessible(train_folder, bench_folder, tmp_path):
    text = make_page(tmp_path, train_folder, bench_folder).read_text()
    assert text.count("<table") == text.count("<caption>") > 4
    assert all(' alt="' in image for image in re.findall(r"<img[^>]*>", text))
    assert '<html lang="en">' in text and 'scope="row"' in text and 'scope="col"' in text


def test_the_json_file_itself_may_be_given(script_folder, tmp_path):
    assert "backwards run" in make_page(tmp_path, script_folder / "skipgs.json").read_text()


def test_a_run_whose_gate_was_never_active_is_shown(script_folder, tmp_path):
    data = json.loads((script_folder / "skipgs.json").read_text())
    data.update(gated_iterations=0, backwards_run=0, backwards_skipped=0, reasons={}, views=[])
    (tmp_path / "skipgs.json").write_text(json.dumps(data))
    text = make_page(tmp_path, tmp_path / "skipgs.json").read_text()
    assert "never active" in text and "<img" not in text


def test_a_page_under_the_name_of_another_format_is_refused(script_folder, tmp_path, capsys):
    assert main(["report", str(script_folder), "--out", str(tmp_path / "page.pdf")]) == 2
    assert "a page is HTML, not .pdf; give a name that ends in .html" in capsys.readouterr().err
    assert not (tmp_path / "page.pdf").exists()
    assert main(["report", str(script_folder), "--out", f"{tmp_path}/pages/"]) == 2
    assert "is a folder; give the name of a page, such as" in capsys.readouterr().err
    assert not (tmp_path / "pages").exists()


def test_folders_without_a_run_are_named(tmp_path, capsys):
    assert main(["report", str(tmp_path / "gone/skipgs.json")]) == 2
    assert "gone/skipgs.json does not exist" in capsys.readouterr().err
    assert main(["report", str(tmp_path)]) == 2
    assert f"{tmp_path} holds neither skipgs.json, bench.json nor stats" in capsys.readouterr().err
    (tmp_path / "stats").mkdir()
    (tmp_path / "stats/train_curve.json").write_text('{"step": [1]}')
    assert main(["report", str(tmp_path)]) == 2
    assert "train_curve.json is damaged" in capsys.readouterr().err
    (tmp_path / "model.spz").write_bytes(b"\x1f\x8b")
    assert main(["report", str(tmp_path / "model.spz")]) == 2
    assert "model.spz is not the skipgs.json or bench.json of a run; give the run's folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "is damaged"),
        ("[1]", "no JSON object"),
        ('{"schema_version": 99}', "schema version 99"),
        ('{"schema_version": 1, "settings": {}}', "no 'iterations' in it"),
        ('{"kind": "skipgs-bench", "schema_version": 2}', "no 'command' in it"),
    ],
)
def test_unusable_input_is_one_sentence(tmp_path, capsys, content, sentence):
    (tmp_path / "skipgs.json").write_text(content)
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "page.html")]) == 2
    error = capsys.readouterr().err.strip()
    assert sentence in error and "skipgs.json" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "page.html").exists()


def test_a_bench_without_decisions_is_shown_and_damaged_ones_are_named(bench_folder, tmp_path, capsys):
    folder = tmp_path / "copy"
    shutil.copytree(bench_folder, folder, ignore=shutil.ignore_patterns("decisions.json", "snapshots"))
    assert "skipped during refinement" not in make_page(tmp_path, folder).read_text()
    (folder / "decisions.json").write_text("{}")
    assert main(["report", str(folder)]) == 2
    assert "decisions.json holds no decisions" in capsys.readouterr().err


def test_an_unfinished_bench_is_named_as_such(tmp_path, capsys):
    (tmp_path / "runs").mkdir()
    (tmp_path / "settings.json").write_text("{}")
    assert main(["report", str(tmp_path)]) == 2
    assert "has not finished" in capsys.readouterr().err


@pytest.mark.parametrize(("share", "cells"), [(0.4, ("40", "-", "-")), ("auto", ("40", "no", "9.00"))])
def test_iterations_left_out_are_told(train_folder, tmp_path, share, cells):
    data = json.loads((train_folder / "skipgs.json").read_text())
    early_stopping = {"ended_early": False, "rest_worth_db": 9.0} if share == "auto" else None
    data |= {"refine_share": 0.4, "iterations_run": 1234, "iterations_skipped": 2000, "early_stopping": early_stopping}
    data["always_run"] = {"line 3: step % 10 == 0": 30, "line 9: saves": 2}
    folder = shutil.copytree(train_folder, tmp_path / "run")
    (folder / "skipgs.json").write_text(json.dumps(data))
    page = make_page(tmp_path, folder).read_text()
    assert rows_of(page, "Whole iterations left out") == [["run", cells[0], "1,234", "2,000", "32", *cells[1:]]]


@pytest.fixture(scope="session")
def shared_folder(scene_file, tmp_path_factory):
    """A run of which whole iterations and densification events are left out."""
    folder = tmp_path_factory.mktemp("train") / "shared"
    command = ["train", scene_file, "--out", str(folder), "--share", "0.5", "--max-steps", "400", "--no-progress"]
    assert main(command) == 0
    return folder


def test_the_phases_of_a_run_are_told_and_the_whole_is_estimated(shared_folder, tmp_path):
    page = make_page(tmp_path, shared_folder).read_text()
    rows = {name: cells for name, *cells in rows_of(page, "The two phases of the run")}
    data = json.loads((shared_folder / "skipgs.json").read_text())
    growing = data["growing"]
    run, left_out = growing["iterations_run"], growing["iterations_skipped"]
    assert run + left_out == 200 and left_out > 0
    ran, skipped = data["iterations_run"], data["iterations_skipped"]
    assert ran + skipped == 200 and skipped > 0
    assert rows["iterations of the schedule"] == ["200", "200", "400"]
    assert rows["iterations left out"] == [f"{left_out}", f"{skipped}", f"{left_out + skipped}"]
    events = str(growing["events_skipped"])
    assert rows["densification events left out"] == [events, "-", events]
    gaussians = json.loads((shared_folder / "stats/train_curve.json").read_text())["num_GS"]
    assert rows["Gaussians at the end"][2] == f"{gaussians[-1]:,}"
    whole = (data["t_total"] - data["t_post"]) * 200 / run + data["t_post"] * 200 / ran
    assert rows["training without left-out iterations, s (estimate)"][2] == f"{whole:.0f}"
    assert "It was not measured" in page and "dashed: the end of growing" in page


def test_a_phase_that_runs_whole_is_told_too():
    gate = {"settings": {"start_iter": 100}, "iterations": 140, "gated_iterations": 40, "t_total": 3.0, "t_post": 1.0}
    gate |= {"iterations_run": 40, "iterations_skipped": 60, "growing": None}
    curve = {"step": [50, 99, 130, 199], "num_GS": [10, 20, 30, 30]}
    growing, refining = phases(gate, curve)
    assert (growing.run, growing.left_out, growing.gaussians, growing.without) == (100, 0, 20, 2.0)
    assert (refining.iterations, refining.gaussians, refining.without) == (100, 30, 2.5)


def test_statistics_of_training_are_no_evaluation(tmp_path):
    """gsplat's script writes time and memory to `train_step*_rank0.json`, also in a run that is never evaluated."""
    (tmp_path / "stats").mkdir()
    for step in (6999, 29999):
        (tmp_path / f"stats/train_step{step}_rank0.json").write_text('{"mem": 1.0, "num_GS": 3}')
    with pytest.raises(SkipGSError, match=r"holds neither skipgs\.json, bench\.json nor stats/val_step"):
        read_source(tmp_path)
