"""One session of a run: it trains the remaining iterations, saves and evaluates on the way, and writes the results."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from skipgs_plug import SkipGate
from skipgs_plug.commands.options.session import SessionOptions
from skipgs_plug.commands.signals import stop_on_signal
from skipgs_plug.core.report import write_report
from skipgs_plug.files import WriteError, keep_going
from skipgs_plug.terminate import UNREAD
from skipgs_plug.trainer import InputError, Trainer
from skipgs_plug.trainer.autosave import Autosave
from skipgs_plug.trainer.curve import LossCurve
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.run_folder import RunFolder
from skipgs_plug.trainer.scalars import ScalarLog

if TYPE_CHECKING:
    from skipgs_plug.view.live import LiveView


class Session:
    """Trains a trainer to its end, and writes the run folder.

    If a file cannot be written, the others are still written, and the run ends with an error that says how to get the
    missing one. This process alone writes to the folder (`trainer.lock`).
    """

    def __init__(
        self, options: SessionOptions, folder: RunFolder, trainer: Trainer, gate: SkipGate | None, curve: LossCurve
    ) -> None:
        self._options, self._folder, self._trainer, self._gate = options, folder, trainer, gate
        self._curve = curve
        self._live: LiveView | None = None
        self._autosave = Autosave(folder, trainer, options.save_every)
        self._split = "val" if trainer.scene.test else "train"
        self._log: ScalarLog | None = None
        self._failed: list[WriteError] = []

    def run(self) -> int:
        """Train, and finish unless a signal stopped training.

        Returns:
            0 for a finished run, 128 + the number of the signal that stopped it, `UNREAD` when nobody reads the
            output.

        Raises:
            InputError: A file could not be written.
        """
        trainer, begun_at = self._trainer, self._trainer.step
        with self._open_log() as self._log, self._open_view() as self._live:
            trainer.on_step = self._after_iteration
            with stop_on_signal(trainer) as stop:
                try:
                    trainer.train(progress=not self._options.no_progress)
                except BrokenPipeError:  # raised between two iterations, so the checkpoint is exact
                    stop.exit_code = UNREAD
                with keep_going(self._failed):
                    self._autosave.save()
            trainer.on_step = None
            if not stop.exit_code:
                if self._gate is not None and trainer.step > begun_at:
                    self._gate.verify()
                self._finish()
        if self._failed:
            count = len(self._failed)
            files = "1 file" if count == 1 else f"{count} files"
            lost = f"{files} of {self._folder.root} could not be written"
            if not self._folder.checkpoints():
                raise InputError(
                    f"{lost}, and there is no checkpoint to continue from; make room, and train from the start with "
                    "another --out, without --resume."
                )
            raise InputError(f"{lost}; make room, and the same command with --resume writes them.")
        if stop.exit_code:
            print(f"Stopped after iteration {trainer.step - 1:,}; the same command with --resume continues.")
        return stop.exit_code

    def _open_view(self) -> contextlib.AbstractContextManager[LiveView | None]:
        if not self._options.view:
            return contextlib.nullcontext()
        from skipgs_plug.view.live import LiveView  # imports the viewer, which few runs open

        live = LiveView(self._trainer)
        print(f"Watch it at http://127.0.0.1:{live.page.port}")
        return live

    def _open_log(self) -> contextlib.AbstractContextManager[ScalarLog | None]:
        if not self._options.tensorboard:
            return contextlib.nullcontext()
        more = self._gate.scalars if self._gate is not None else dict
        return ScalarLog(self._folder.root / "tb", self._trainer, more)

    def _after_iteration(self, iteration: Iteration) -> None:
        self._curve.iteration(iteration)
        if self._live is not None:
            self._live.iteration(iteration)
        if self._log is not None:
            self._log.iteration(iteration)
        every = self._options.eval_every
        if every and iteration.completes(every) and iteration.step + 1 < self._trainer.max_steps:
            from tqdm.auto import tqdm

            tqdm.write(f"Iteration {iteration.step:,}: {self._described(self._evaluate([]))}")
        self._autosave.iteration(iteration)

    def _evaluate(self, failed: list[WriteError], keep: Any = None) -> dict[str, Any]:
        stats = self._trainer.evaluate("test" if self._split == "val" else "train", self._options.lpips_net, keep)
        with keep_going(failed):
            self._folder.write_stats(self._trainer, stats, self._split)
        if self._log is not None:
            self._log.evaluation(stats, self._split)
        return stats

    def _finish(self) -> None:
        """Evaluate, write all files of a finished run, also those that an earlier session could not write, and report.

        The report comes last: a reader who is gone ends the command there.
        """
        folder, trainer, said = self._folder, self._trainer, []
        with keep_going(self._failed), folder.renders(trainer, self._split) as keep:
            stats = self._evaluate(self._failed, keep)
        with keep_going(self._failed):
            self._curve.write(folder.root / "stats" / "train_curve.json")
        with keep_going(self._failed):
            said.append(str(folder.write_ply(trainer)))
        if self._gate is not None:
            with keep_going(self._failed):
                write_report(self._gate, folder.root / "skipgs.json", frame=trainer.scene.frame.as_dict())
            said.append(self._gate.summary())
        said.append(f"{self._described(stats)}; T_total {trainer.t_total:.1f} s, T_post {trainer.t_post:.1f} s")
        print("\n".join(said))

    def _described(self, stats: dict[str, Any]) -> str:
        net = self._options.lpips_net
        held_out = f"{stats['views']} held-out view{'' if stats['views'] == 1 else 's'}"
        where = held_out if self._split == "val" else "TRAINING views (none held out)"
        lpips = f", LPIPS ({net}) {stats[f'lpips_{net}']:.4f}" if net else ""
        fitted = f" ({stats['cc_psnr']:.2f} with colours fitted to each)" if "cc_psnr" in stats else ""
        return (
            f"PSNR {stats['psnr']:.2f} dB{fitted}, SSIM {stats['ssim']:.4f} (torchmetrics padding){lpips} on {where}; "
            f"{stats['num_GS']:,} Gaussians"
        )
