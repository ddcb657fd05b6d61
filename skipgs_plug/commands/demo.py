"""`skipgs-plug demo`: densify once, refine from that snapshot as it is, gated and in fewer iterations, compare."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skipgs_plug import SkipGate
from skipgs_plug.commands.names import require_names
from skipgs_plug.commands.options.demo import Args
from skipgs_plug.core.report import write_report
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.lock import exclusive
from skipgs_plug.trainer.pictures import Curve, plot_refinement, save_comparison
from skipgs_plug.trainer.run_folder import RunFolder
from skipgs_plug.trainer.synthetic import make_scene

# Arguments of the gate by name of the refinement, as in the bench; None for the trainer's own.
GATES: dict[str, dict[str, Any] | None] = {"own": None, "gate": {}, "refine_share=0.4": {"refine_share": 0.4}}


@dataclass
class Result:
    """One refinement of the snapshot."""

    name: str
    curve: Curve
    stats: dict[str, Any]
    renders: list[Any]
    t_post: float
    t_total: float
    run: int
    skipped: int


def run(args: Args) -> int:
    """Run the demo in its folder; see `Args`."""
    require_names(("--out", args.out))
    with exclusive(Path(args.out)):
        compare(args)
    return 0


def compare(args: Args) -> list[Result]:
    """Train and return the results; prints the table, writes models and pictures to `out`."""
    out = Path(args.out)
    print(f"Ray tracing {args.views} images ...")
    scene = make_scene(args.views, args.width, args.width * 3 // 4, args.points)
    config = TrainConfig(result_dir=args.out, max_steps=args.max_steps, backend=args.backend, seed=args.seed)  # type: ignore[arg-type]
    trainer = Trainer(config, scene)
    print(f"Densifying on backend {trainer.backend.name} (its kernels compile on first use: half a minute) ...")
    trainer.train(until=trainer.refine_stop_iter, progress=not args.no_progress)
    snapshot = trainer.snapshot()
    results = []
    for name in GATES:
        print(f"Refining from that snapshot, {name} ...")
        trainer.restore(snapshot)
        results.append(refine(name, trainer, RunFolder(out / name), progress=not args.no_progress))
    save_comparison(out / "comparison.png", scene.test, {result.name: result.renders for result in results})
    plot_refinement(out / "refinement.png", [result.curve for result in results])
    print(table(results, trainer))
    print(f"\nPictures: {out / 'comparison.png'}, {out / 'refinement.png'}; models: {out}/*/ply")
    return results


def refine(name: str, trainer: Trainer, folder: RunFolder, progress: bool) -> Result:
    """Train to the end under the gate of that name, and evaluate."""
    settings = GATES[name]
    gate = None if settings is None else SkipGate(trainer, **settings)
    curve = Curve(name)
    trainer.on_step = lambda it: curve.add(it.step, it.loss, gate is not None and gate.skipped)
    trainer.train(progress=progress)
    trainer.on_step = None
    stats = trainer.evaluate("test")
    folder.write_config(
        trainer.config, near_plane=trainer.near_plane, gate=None if gate is None else gate.config.as_dict()
    )
    folder.write_stats(trainer, stats)
    folder.write_ply(trainer)
    if gate is not None:
        gate.verify()
        write_report(gate, folder.root / "skipgs.json")
        gate.detach()
    skipped = sum(curve.skipped)
    renders = [trainer.render(view).cpu() for view in trainer.scene.test]
    run = len(curve.skipped) - skipped
    return Result(name, curve, stats, renders, trainer.t_post, trainer.t_total, run, skipped)


def table(results: list[Result], trainer: Trainer) -> str:
    """Return the comparison, one row per refinement."""
    head = ("", "T_post s", "T_total s", "it/s", "backwards", "skipped", "PSNR dB", "SSIM")
    rows = [head]
    for r in results:
        rate = (r.run + r.skipped) / r.t_post
        psnr, ssim = f"{r.stats['psnr']:.2f}", f"{r.stats['ssim']:.4f}"
        rows.append(
            (r.name, f"{r.t_post:.1f}", f"{r.t_total:.1f}", f"{rate:.1f}", str(r.run), str(r.skipped), psnr, ssim)
        )
    lines = [f"{name:>18}" + "".join(f"{cell:>11}" for cell in row) for name, *row in rows]
    plain, *others = results
    saved = [100 * (1 - one.t_post / plain.t_post) for one in others]
    return "\n".join(
        [
            "",
            *lines,
            "",
            f"Refinement took {saved[0]:.0f} % less time with the gate, {saved[1]:.0f} % less in 40 % of the "
            "iterations, with larger steps.",
            f"{len(trainer.scene.test)} held-out views, {plain.stats['num_GS']:,} Gaussians,",
            f"iterations {trainer.refine_stop_iter:,} to {trainer.max_steps:,}, backend {trainer.backend.name}; "
            "SSIM with torchmetrics padding. T_post is refinement, T_total includes",
            "densification; evaluation and compilation are outside both. One seed: `skipgs-plug bench` "
            "compares with controls over several.",
        ]
    )
