"""`skipgs-plug bench SCENE`: compare the time and quality of policies on a scene."""

from __future__ import annotations

import dataclasses

from skipgs_plug.bench.decisions import FILE as DECISIONS
from skipgs_plug.bench.decisions import write_decisions
from skipgs_plug.bench.find import known_policies, require_policies
from skipgs_plug.bench.plots import write_plots
from skipgs_plug.bench.result import build_result
from skipgs_plug.bench.runner import Bench
from skipgs_plug.bench.store import BenchFolder
from skipgs_plug.bench.summary import Row, row_from_dict
from skipgs_plug.bench.table import legend, markdown, notes, tables
from skipgs_plug.commands.options.bench import Args
from skipgs_plug.install import next_command
from skipgs_plug.trainer import load_scene
from skipgs_plug.trainer.files import write_aside, write_json
from skipgs_plug.trainer.lock import exclusive


def run(args: Args) -> int:
    """Run the policies that are missing, and print and write the results; see `Args`."""
    compare(args)
    return 0


def compare(args: Args) -> list[Row]:
    """Run the missing policies, print the table, write bench.json, decisions.json, table.md and plots; return rows."""
    whole = args.whole
    policies = tuple(known_policies(whole)) if args.policies is None else args.policies
    require_policies(policies, whole)
    config = dataclasses.replace(args.train, data_dir=args.scene, result_dir=args.out)
    scene = load_scene(args.scene, config.data_factor, config.test_every, config.init_num_pts, config.init_ply)
    folder = BenchFolder(args.out)
    progress, tensorboard, clock = not args.no_progress, args.tensorboard, args.clock
    bench = Bench(
        *(scene, config, folder, args.seeds, policies),
        progress=progress,
        tensorboard=tensorboard,
        clock=clock,
        whole=whole,
    )
    print(
        f"{scene.name}: {len(args.seeds)} seeds x {len(policies)} policies, iterations to {config.max_steps:,}, "
        f"densification to {bench.refine_stop_iter:,}, backend {bench.backend.name}"
    )
    with exclusive(folder.root):
        records = bench.run()
    result = build_result(bench, records, args.command)
    rows = [row_from_dict(row) for row in result["rows"]]
    parts = [
        *(f"{caption}:\n\n{markdown(lines)}" for caption, lines in tables(rows, whole)),
        "\n\n".join(notes(rows, result)),
        "\n".join(f"- {name}: {meaning}" for name, meaning in legend(rows, whole)),
    ]
    text = "\n\n".join(parts) + "\n"
    write_json(folder.root / "bench.json", result)
    write_decisions(folder.root / DECISIONS, records)
    with write_aside(folder.root / "table.md") as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
    write_plots(folder.root, records, rows, result["view_names"], whole)
    page = next_command("report", folder.root)
    print(f"\n{text}\nTable, plots and bench.json: {folder.root}; {page} makes one page.")
    return rows
