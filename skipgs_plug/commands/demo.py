"""`skipgs-plug demo`: train a small scene as it is, with the paper's gate and with share="auto", and compare."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skipgs_plug import SkipGate
from skipgs_plug.commands.names import require_folder
from skipgs_plug.commands.options.demo import Args
from skipgs_plug.core.report import write_report
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.ahead import prepare_kernels
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.lock import exclusive
from skipgs_plug.trainer.pictures import Curve, plot_refinement, save_comparison
from skipgs_plug.trainer.run_folder import RunFolder
from skipgs_plug.trainer.synthetic import make_scene

# Four times the recipe's threshold, which would make more Gaussians than such small pictures have pixels.
GROW_GRAD2D = 0.0008

# Settings of the gate by the name of the run; None for the trainer's own run. The bench uses the same names.
GATES: dict[str, dict[str, Any] | None] = {"own": None, "gate": {}, "share=auto": {"share": "auto"}}


@dataclass
class Result:
    """One finished run."""

    name: str
    curve: Curve
    stats: dict[str, Any]
    renders: list[Any]
    t_post: float
    t_total: float
    iterations: int  # number in the whole run
    backwards: int


# Least values of options: an iteration before and one after the end of densification, a held-out view and one to train
# on, a height of 11 pixels for SSIM, and the points from which distances to three neighbours can be measured.
LEAST = {"max_steps": 2, "views": 2, "width": 15, "points": 4}


def run(args: Args) -> int:
    """Run the demo in its folder; see `Args`."""
    require_folder(args.out)
    for name, least in LEAST.items():
        if getattr(args, name) < least:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} {getattr(args, name)} is too small for the demo; give at least {least}.")
    with exclusive(Path(args.out)):
        compare(args)
    return 0


def compare(args: Args) -> list[Result]:
    """Train and return the results; prints the table, writes models and pictures to `out`."""
    out = Path(args.out)
    config = TrainConfig(
        result_dir=args.out,
        max_steps=args.max_steps,
        backend=args.backend,
        seed=args.seed,
        grow_grad2d=GROW_GRAD2D,
    )
    prepare_kernels(config)
    print(f"Ray tracing {args.views} images ...")
    scene = make_scene(args.views, args.width, args.width * 3 // 4, args.points)
    trainer = new_trainer(config, scene)
    print(f"Densifying on backend {trainer.backend.name} (its kernels compile on first use: half a minute) ...")
    trainer.train(until=trainer.refine_stop_iter, progress=not args.no_progress)
    snapshot = trainer.snapshot()
    results = []
    for name, settings in GATES.items():
        if settings is not None and "share" in settings:
            print(f"Training from the first iteration, {name} ...")
            trainer = new_trainer(config, scene)
        else:
            print(f"Refining, {name} ...")
            trainer.restore(snapshot)
        results.append(finish(name, trainer, RunFolder(out / name), progress=not args.no_progress))
    save_comparison(out / "comparison.png", scene.test, {result.name: result.renders for result in results})
    plot_refinement(out / "refinement.png", [result.curve for result in results])
    print(table(results, trainer))
    print(f"\nPictures: {out / 'comparison.png'}, {out / 'refinement.png'}; models: {out}/*/ply")
    return results


def new_trainer(config: TrainConfig, scene: Scene) -> Trainer:
    """Return a trainer that counts processor seconds on the CPU, so that other programs do not disturb the times."""
    trainer = Trainer(config, scene)
    trainer.clock = TrainClock(trainer.backend.device, by_processor=trainer.backend.device.type == "cpu")
    return trainer


def finish(name: str, trainer: Trainer, folder: RunFolder, progress: bool) -> Result:
    """Train to the end under the gate of that name, and evaluate."""
    settings = GATES[name]
    gate = None if settings is None else SkipGate(trainer, **settings)
    curve = Curve(name)
    iterations = backwards = trainer.step

    def record(it: Any) -> None:
        nonlocal iterations, backwards
        skipped = gate is not None and gate.skipped
        iterations += 1
        backwards += not skipped
        if it.step >= trainer.refine_stop_iter:
            curve.add(it.step, it.loss, skipped)

    trainer.on_step = record
    trainer.train(progress=progress)
    trainer.on_step = None
    stats = trainer.evaluate("test")
    folder.write_config(trainer, None if gate is None else gate.config.as_dict())
    folder.write_stats(trainer, stats)
    folder.write_ply(trainer)
    if gate is not None:
        gate.verify()
        write_report(gate, folder.root / "skipgs.json")
        gate.detach()
    renders = [trainer.render(view).cpu() for view in trainer.scene.test]
    return Result(name, curve, stats, renders, trainer.t_post, trainer.t_total, iterations, backwards)


def table(results: list[Result], trainer: Trainer) -> str:
    """Return the comparison, one row per run."""
    rows = [("", "T_total s", "T_post s", "iterations", "backwards", "Gaussians", "PSNR dB", "SSIM")]
    for r in results:
        times = f"{r.t_total:.1f}", f"{r.t_post:.1f}"
        quality = f"{r.stats['num_GS']:,}", f"{r.stats['psnr']:.2f}", f"{r.stats['ssim']:.4f}"
        rows.append((r.name, *times, f"{r.iterations:,}", f"{r.backwards:,}", *quality))
    own, *others = results
    clock = " in processor seconds" if trainer.backend.device.type == "cpu" else ""
    changes = [
        f"{one.name} took {100 * one.t_total / own.t_total:.0f} % of the time, "
        f"{one.stats['psnr'] - own.stats['psnr']:+.2f} dB"
        for one in others
    ]
    return "\n".join(
        [
            "",
            *(f"{name:>12}" + "".join(f"{cell:>11}" for cell in row) for name, *row in rows),
            "",
            f"{'; '.join(changes)}.",
            f"{len(trainer.scene.test)} held-out views; iteration {trainer.refine_stop_iter:,} of {trainer.max_steps:,}"
            f" ends densification; backend {trainer.backend.name}.",
            f"T_total is the time of training{clock}, T_post of its part after densification, both without evaluation "
            "and compilation.",
            "This is one seed of one small scene: `skipgs-plug bench` compares with controls over several seeds.",
        ]
    )
