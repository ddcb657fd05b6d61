"""`skipgs-plug train SCENE --out RUN`: the reference trainer, gated unless told otherwise."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from skipgs_plug import SkipGate
from skipgs_plug.commands.gate_options import GateOptions
from skipgs_plug.core.report import write_report
from skipgs_plug.trainer import InputError, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.metrics import require_lpips
from skipgs_plug.trainer.run_folder import RunFolder
from skipgs_plug.trainer.scalars import ScalarLog

INTERRUPTED = 130


@dataclass
class Options(TrainConfig):
    """TrainConfig without the two folders, which the command takes as SCENE and --out."""

    data_dir: tyro.conf.Suppress[str] = ""
    result_dir: tyro.conf.Suppress[str] = ""


@dataclass
class Args:
    """Train a COLMAP, nerfstudio or Blender folder or a packed .npz."""

    scene: tyro.conf.Positional[str]
    """Folder with sparse/0, transforms.json or transforms_train.json, or packed .npz."""
    out: str
    """Run folder to write."""
    train: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    gate: tyro.conf.OmitArgPrefixes[GateOptions] = dataclasses.field(default_factory=GateOptions)
    no_gate: bool = False
    """Train without the gate."""
    resume: bool = False
    """Continue from the last checkpoint in --out."""
    tensorboard: bool = False
    """Log gsplat's scalars and the gate's counters to RUN/tb, every tenth iteration."""
    lpips_net: Literal["alex", "vgg"] | None = None
    """Also report LPIPS; its weights must be on this machine."""
    no_progress: bool = False
    """No progress bar."""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="skipgs-plug train", config=(tyro.conf.FlagCreatePairsOff,))
    return run(args)


def run(args: Args) -> int:
    """Train, then write checkpoint, PLY, renders, stats and skipgs.json; on Ctrl-C only the checkpoint."""
    config = dataclasses.replace(args.train, data_dir=args.scene, result_dir=args.out)
    folder = RunFolder(args.out)
    if args.lpips_net is not None:
        require_lpips(args.lpips_net)
    if not args.resume and folder.has_checkpoints():
        raise InputError(f"{args.out} already holds a run; add --resume to continue it or give another --out.")
    checkpoint = folder.latest_checkpoint() if args.resume else None
    scene = load_scene(args.scene, config.data_factor, config.test_every, config.init_num_pts, config.init_ply)
    trainer = Trainer(config, scene)
    gate = None if args.no_gate else SkipGate(trainer, **args.gate.given())
    if checkpoint is not None:
        trainer.load_checkpoint(checkpoint)
    folder.write_config(config, gate=None if gate is None else gate.config.as_dict())
    print(
        f"{scene.name}: {len(scene.train)} training views, {len(scene.test)} held out, {len(scene.points):,} points, "
        f"backend {trainer.backend.name}, iterations {trainer.step:,} to {trainer.max_steps:,}"
        + (f", gate active from {trainer.refine_stop_iter:,}" if gate is not None else ", no gate")
    )
    more = gate.scalars if gate is not None else dict
    with ScalarLog(folder.root / "tb", trainer, more) if args.tensorboard else contextlib.nullcontext() as log:
        trainer.on_step = None if log is None else log.iteration
        with stop_on_interrupt(trainer):
            trainer.train(progress=not args.no_progress)
        if trainer.step > 0:
            folder.write_checkpoint(trainer)
        if trainer.step < trainer.max_steps:
            print(f"Stopped after iteration {trainer.step - 1:,}; the same command with --resume continues.")
            return INTERRUPTED
        finish(args, folder, trainer, gate, log)
    return 0


def finish(args: Args, folder: RunFolder, trainer: Trainer, gate: SkipGate | None, log: ScalarLog | None) -> None:
    """Evaluate and write everything that a finished run leaves."""
    split: Literal["val", "train"] = "val" if trainer.scene.test else "train"
    stats = trainer.evaluate("test" if split == "val" else "train", args.lpips_net)
    folder.write_stats(trainer, stats, split)
    if log is not None:
        log.evaluation(stats, split)
    folder.write_renders(trainer, split)
    ply = folder.write_ply(trainer)
    if gate is not None:
        gate.verify()
        write_report(gate, folder.root / "skipgs.json")
        print(gate.summary())
    where = f"{stats['views']} held-out views" if split == "val" else "TRAINING views (none held out)"
    lpips = f", LPIPS ({args.lpips_net}) {stats[f'lpips_{args.lpips_net}']:.4f}" if args.lpips_net else ""
    print(
        f"PSNR {stats['psnr']:.2f} dB, SSIM {stats['ssim']:.4f} (torchmetrics padding){lpips} on {where}; "
        f"{stats['num_GS']:,} Gaussians; T_total {trainer.t_total:.1f} s, T_post {trainer.t_post:.1f} s\n{ply}"
    )


@contextlib.contextmanager
def stop_on_interrupt(trainer: Trainer) -> Iterator[None]:
    """Let Ctrl-C end training between two iterations, so that the checkpoint is exact; twice ends at once."""

    def stop(number: int, frame: Any) -> None:
        if trainer.stop_requested:
            raise KeyboardInterrupt
        trainer.stop_requested = True

    previous: Callable[..., Any] | int | None
    try:
        previous = signal.signal(signal.SIGINT, stop)
    except ValueError:  # not the main thread: whoever owns it handles Ctrl-C
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
