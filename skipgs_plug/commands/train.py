"""`skipgs-plug train SCENE --out RUN`: the reference trainer, with a gate if options ask for one."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import os
from pathlib import Path
from typing import Any

from skipgs_plug import SkipConfig, SkipGate
from skipgs_plug.commands.gate_settings import GateSettings
from skipgs_plug.commands.names import require_folder
from skipgs_plug.commands.options.sfm import Args as SfmArgs
from skipgs_plug.commands.options.train import Args
from skipgs_plug.commands.session import Session
from skipgs_plug.files import BENCH_SETTINGS, write_aside
from skipgs_plug.garbage import uncollected
from skipgs_plug.install import next_command
from skipgs_plug.photos.gather import are_photographs
from skipgs_plug.photos.origin import check_origin, described
from skipgs_plug.trainer import InputError, MissingFileError, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.ahead import prepare_kernels
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.config import REFERENCE_STEPS
from skipgs_plug.trainer.curve import LossCurve
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders import is_scene
from skipgs_plug.trainer.lock import exclusive
from skipgs_plug.trainer.metrics import require_lpips
from skipgs_plug.trainer.ply import read_start
from skipgs_plug.trainer.resume import first_sound, lengths
from skipgs_plug.trainer.run_folder import SCENE, RunFolder
from skipgs_plug.trainer.scene import all_held_out
from skipgs_plug.view.spz import to_spz


def run(args: Args) -> int:
    """Train, then write checkpoint, PLY, renders, stats and skipgs.json; on Ctrl-C and SIGTERM only the checkpoint.

    Returns:
        0 for a finished run, 128 + number of the signal for one that was stopped.
    """
    folder = RunFolder(args.out)
    found = folder.checkpoints()
    check(args, found)
    if args.sfm:
        args = dataclasses.replace(args, scene=str(scene_of_photographs(args, folder)))
    checkpoints, config = configure(args, found)
    with uncollected():
        prepare_kernels(config)
        memory = args.session.image_memory
        images = ImageStore(None if memory is None else round(memory * 1e9), progress=not args.session.no_progress)
        loading = (config.data_factor, config.test_every, config.init_num_pts, config.init_ply)
        scene = load_scene(args.scene, *loading, images)
        trainer = Trainer(config, scene)
    settings = args.gate_options.given()
    begun_with = GateSettings(None)
    trainer.register_state("gate_settings", begun_with)  # before the gate, whose state says less about another setting
    gate = SkipGate(trainer, **settings) if args.gate or settings else None
    begun_with.gate = gate
    curve = LossCurve(trainer)
    with exclusive(folder.root), gate or contextlib.nullcontext():
        if folder.checkpoints() != found:
            raise InputError(f"Another process trained in {args.out} just now; give the command again.")
        folder.remove_leftovers()
        if checkpoints:
            first_sound(checkpoints, trainer.load_checkpoint)
        folder.write_config(trainer, None if gate is None else gate.config.as_dict())
        print(
            f"{scene.name}: {len(scene.train)} training views, {len(scene.test)} held out, "
            f"{len(scene.points):,} points, backend {trainer.backend.name}, "
            f"iterations {trainer.step:,} to {trainer.max_steps:,}"
            + (f", gate active from {gate.config.start_iter:,}" if gate is not None else "")
        )
        code = Session(args.session, folder, trainer, gate, curve).run()
    if not code:
        shared = small_file(folder, trainer) if args.sfm else ""
        print(f"Next: {next_command('view', folder.root)}{shared}")
    return code


def small_file(folder: RunFolder, trainer: Trainer) -> str:
    """Write the model as a file that is small enough to send, and return the words that name it.

    A model that does not fit the format is not written, which one sentence says: the run is finished all the same.
    """
    path = folder.root / f"{folder.root.resolve().name}.spz"
    local = {name: parameter.detach().cpu() for name, parameter in trainer.splats.items()}
    try:
        data = to_spz(trainer.scene.frame.dataset_splats(local), trainer.config.antialiased)
    except InputError as error:
        print(f"{path.name} is left out: {error}")
        return ""
    with write_aside(path, len(data)) as temporary:
        temporary.write_bytes(data)
    return f"; share it: {path} ({len(data) / 1e6:.1f} MB)"


def check(args: Args, checkpoints: list[Path]) -> None:
    """Refuse options that do not fit, before a scene is read.

    Raises:
        InputError: LPIPS cannot be computed, --out cannot be a folder, --resume does not fit its content, --sfm does
            not fit SCENE, the scene in --out was made of other photographs, or see `check_ahead`.
        SkipGSError: A setting of the gate is out of its range.
    """
    require_folder(args.out)
    SkipConfig(**args.gate_options.given())
    given, scene = Path(args.scene).expanduser(), RunFolder(args.out).root / SCENE
    if args.sfm and checkpoints and not is_scene(scene):
        raise InputError(
            f"{scene}, which --sfm makes, is not there, and {args.out} holds a run; give the scene that it was trained "
            "on, without --sfm."
        )
    reads_photographs = args.sfm and not (args.resume and is_scene(scene))
    if reads_photographs and not given.exists():
        raise MissingFileError(f"{args.scene} does not exist; give a video or a folder with photographs.")
    if reads_photographs and not are_photographs(given):
        what = "is a scene already" if is_scene(given) else "is neither a video nor a folder with photographs"
        raise InputError(f"{args.scene} {what}; leave out --sfm or give photographs.")
    if not args.sfm and are_photographs(given):
        raise InputError(
            f"{args.scene} holds photographs but no cameras; add --sfm to reconstruct them "
            f"first, or run: {next_command('sfm', args.scene, 'SCENE')}."
        )
    import plyfile  # noqa: F401 - otherwise only the written model would show that it is missing, after training

    if args.session.lpips_net is not None:
        require_lpips(args.session.lpips_net)
    if checkpoints and not args.resume:
        raise InputError(f"{args.out} already holds a run; add --resume to continue it or give another --out.")
    if args.resume and not checkpoints:
        raise MissingFileError(f"{args.out} holds no checkpoint (ckpts/ckpt_*_rank0.pt); start without --resume.")
    if (Path(args.out).expanduser() / BENCH_SETTINGS).is_file():
        raise InputError(f"{args.out} holds a bench, with which a run would be mixed; give another --out.")
    results = RunFolder(args.out).results()
    if results and not checkpoints:
        raise InputError(
            f"{args.out} holds files of a run without a checkpoint ({results[0]}), with which a new run would be "
            "mixed; give another --out, or move them away."
        )
    if reads_photographs and is_scene(scene):
        check_origin(scene, given)
    elif reads_photographs:
        check_ahead(args)


def check_ahead(args: Args) -> None:
    """Refuse before structure from motion, which takes minutes, what training would refuse after it.

    Raises:
        InputError: The backend cannot run here, --init-ply cannot be read, or all views would be held out.
        ModuleNotFoundError: A package is not installed that --view or --tensorboard needs.
    """
    resolve_backend(args.train.backend)
    if args.train.init_ply:
        read_start(args.train.init_ply)
    if args.train.test_every == 1:
        raise all_held_out(Path(args.scene))
    for package, needed in (("viser", args.session.view), ("tensorboard", args.session.tensorboard)):
        if needed:
            importlib.import_module(package)


def scene_of_photographs(args: Args, folder: RunFolder) -> Path:
    """Return the scene of the run's photographs. It is reconstructed in the run's folder if it is not there yet."""
    scene = folder.root / SCENE
    if is_scene(scene):
        print(described(scene))
    else:
        from skipgs_plug.commands import sfm  # imports pycolmap, which training does not need

        with exclusive(folder.root):
            sfm.reconstruct(SfmArgs(Path(args.scene), scene, no_progress=args.session.no_progress))
    return scene


def configure(args: Args, checkpoints: list[Path]) -> tuple[list[Path], TrainConfig]:
    """Return the checkpoints from the newest readable one on, and the settings of the run.

    A resumed run keeps its schedule. It keeps its length too, unless the options give another one.

    Raises:
        InputError: The run would be extended, but its learning rates fall to 0 at the end of its schedule.
    """
    run: dict[str, Any] = {"max_steps": REFERENCE_STEPS}
    if checkpoints:
        checkpoints, run = first_sound(checkpoints, lengths)
    if args.max_steps is not None:
        run["max_steps"] = args.max_steps
    # Later commands may run in another folder.
    paths = (args.scene, args.train.init_ply)
    scene, start = (os.path.abspath(Path(path).expanduser()) if path else "" for path in paths)
    config = dataclasses.replace(args.train, data_dir=scene, init_ply=start, result_dir=args.out, **run)
    compensates = SkipConfig(**args.gate_options.given()).compensates
    if args.max_steps is not None and args.max_steps > config.schedule and compensates:
        raise InputError(
            f"Under this gate, learning rates fall to 0 at iteration {config.schedule:,}, and more iterations change "
            f"nothing; leave out --max-steps, or train anew with --max-steps {config.max_steps} and another --out."
        )
    return checkpoints, config
