"""`skipgs-plug run ADAPTER -- train.py ...`: an unmodified training script, gated."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from skipgs_plug import SkipGate, SkipGSError, UnknownTrainerError
from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import find_adapter_beside, find_script_adapter, get_adapter
from skipgs_plug.commands.options.gate import GateOptions
from skipgs_plug.commands.options.run import Args
from skipgs_plug.compat import FAMILIES, serve
from skipgs_plug.compat.child_processes import also_in_children
from skipgs_plug.core.caution import cautioned
from skipgs_plug.core.errors import AdapterMismatchError, BrokenTrainingError
from skipgs_plug.core.report import write_report
from skipgs_plug.fallback_raster import ADAM_REPLACED, instead_of_torchs_adam
from skipgs_plug.files import WriteError
from skipgs_plug.messages import say, show
from skipgs_plug.scripts import spawned
from skipgs_plug.scripts.checkpoints import REPLACED, Checkpoints
from skipgs_plug.scripts.cuda_redirect import REPLACED as CUDA_REPLACED
from skipgs_plug.scripts.cuda_redirect import cuda_on_cpu, exclusive_cores
from skipgs_plug.scripts.exits import before_process_ends
from skipgs_plug.scripts.kept_memory import freed_memory_kept
from skipgs_plug.scripts.launch import Attach, run_script, source_of
from skipgs_plug.scripts.processes import Beginning, told_if_it_starts_itself, told_if_it_trains

ARGPARSE_ERROR = 2  # exit code of a script whose arguments argparse does not know


def run(args: Args) -> int:
    """Run the script and write skipgs.json; see `Args`.

    Returns:
        The script's exit code.

    Raises:
        SkipGSError: The script cannot be run or gated.
    """
    command = list(args.command)
    if args.adapter == "auto":
        adapter = find_adapter(args, command)
        if adapter is None:
            return run_script(command, dict)
        args = dataclasses.replace(args, adapter=adapter)
        say(f"{script_name(command)} is run as {args.adapter}.")
    with spawned.gated_when_spawned(functools.partial(run_spawned, args, command)) as processes:
        stand_ins = FAMILIES.get(get_adapter(args.adapter).stand_ins_for(command), {})
        execute = functools.partial(run_script, command, on_cpu=args.cpu, stand_ins=stand_ins)
        rank = int(os.environ.get("RANK") or 0)  # torchrun sets it
        spawned_untold = functools.partial(told_if_it_trains, script_name(command))
        begins = Beginning()
        with contextlib.nullcontext() if args.no_gate else also_in_children(spawned_untold):
            code, gate = run_gated(args, command, execute, begins, rank)
    verify(code, gate)
    if code == ARGPARSE_ERROR and not (gate is not None and gate.trained) and (misplaced := own_options(command)):
        say(f"If {misplaced} was meant for skipgs-plug, write it before '--'.")
    seen = args.no_gate if gate is None else gate.trained or gate.released
    if code == 0 and not processes and not seen and not begins.anywhere:
        say(
            f"{script_name(command)} ended without a training iteration that adapter {args.adapter!r} knows; nothing "
            "was gated."
        )
    return code


def own_options(command: Sequence[str]) -> str:
    """Return the arguments of the script that are options of skipgs-plug too, as one text."""
    own = {f"--{field.name.replace('_', '-')}" for kind in (Args, GateOptions) for field in dataclasses.fields(kind)}
    return ", ".join(word for word in command if word.partition("=")[0] in own)


def find_adapter(args: Args, command: list[str]) -> str | None:
    """Return the name of the adapter that knows the script; None if no adapter does, and the script needs none.

    Raises:
        UnknownTrainerError: No adapter knows the script, and it should be gated, or needs stand-ins for CUDA modules.
    """
    try:
        return find_script_adapter(source_of(command)).name
    except (UnknownTrainerError, AdapterMismatchError) as error:  # the script may be compiled, or a zip archive
        if not args.no_gate:
            raise
        if args.cpu:
            if (beside := find_adapter_beside(source_of(command))) is not None:
                return beside.name
            raise UnknownTrainerError(
                f"--cpu replaces the CUDA modules of trainers that an adapter knows, and none knows "
                f"{script_name(command)}: run it without --cpu, or name the adapter of the trainer that it was forked "
                "from."
            ) from error
        say_ungated(command, error)
        return None


def run_spawned(args: Args, command: list[str], rank: int, call: bytes) -> None:
    """Do the work of a process that the script spawns: attach a gate like `run`, then make the script's call."""
    execute = functools.partial(spawned.run_call, command, rank=rank, call=call, on_cpu=args.cpu)
    code, gate = run_gated(args, command, execute, Beginning(), rank)
    if code:
        sys.exit(code)
    verify(code, gate)


def verify(code: int, gate: SkipGate | None) -> None:
    """Check that the gate of a finished run has seen one training backward per iteration.

    Raises:
        SkipGSError: The numbers differ, and the gate did not say so during the run.
    """
    if code or gate is None or not gate.trained or not gate.config.enabled:
        return
    gate.verify()


def run_gated(
    args: Args, command: list[str], execute: Callable[[Attach], int], begins: Beginning, rank: int = 0
) -> tuple[int, SkipGate | None]:
    """Attach a gate to the script that `execute(attach)` runs, and write skipgs.json if `rank` is 0.

    `begins` is told when training begins. A process that the script forks has the gate too, and reports if it trained.

    A run that the gate refuses has trained nothing, so it leaves a report of an earlier run as it is.
    """
    adapter = get_adapter(args.adapter)()
    # Without a gate nothing is refused that only a gate would need.
    checkpoints = Checkpoints(args.adapter, script_name(command), "off" if args.no_gate else args.resume_gate)
    for_cpu = (*CUDA_REPLACED, ADAM_REPLACED)
    adapter.replaced = (*REPLACED, *(for_cpu if args.cpu else ()))
    off = {"enabled": False, "start_iter": args.gate_options.start_iter}  # `t_post` begins there without a gate, too
    settings = off if args.no_gate else args.gate_options.given()
    gates: list[SkipGate] = []
    refused, process = False, os.getpid()

    def first_iteration(number: int) -> dict[str, Any] | None:
        begins.note()
        return checkpoints.state_for(number)

    def attach() -> dict[str, Any]:
        adapter.saved_state, adapter.script = first_iteration, source_of(command)
        try:
            gates.append(SkipGate(adapter=adapter, **settings))
        except SkipGSError as error:
            if not args.no_gate:
                raise
            say_ungated(command, error)
            return {}
        checkpoints.gate = gates[0]
        return gates[0].script_globals

    def finish() -> None:
        for gate in gates:
            with cautioned("Detaching the gate"):  # the script has done its work, so its exit code stands
                gate.detach()
            if rank == 0 and not refused and begins.here:
                report(gate, adapter)

    def untrained() -> bool:
        return any(gate.config.enabled and not gate.trained and not gate.released for gate in gates)

    def replaced(program: str) -> None:
        if os.getpid() != process:
            return
        if untrained():
            raise SkipGSError(
                f"{script_name(command)} puts {program} in the place of its process before it trains, and no gate "
                "reaches that program; if it restarts itself to change a setting, such as a variable of the "
                "environment, make that setting before skipgs-plug run."
            )
        finish()

    with cpu_instead_of_cuda(args, command) if args.cpu else contextlib.nullcontext():
        try:
            starts_itself = told_if_it_starts_itself(source_of(command), untrained)
            with checkpoints.watch(), before_process_ends(finish, replaced), starts_itself:
                code = execute(attach)
        except SkipGSError as error:
            refused = not isinstance(error, BrokenTrainingError)
            raise
        finally:
            finish()
    return code, gates[0] if gates else None


def say_ungated(command: Sequence[str], error: SkipGSError) -> None:
    say(f"{script_name(command)} runs without a gate, and so without skipgs.json: {error}")


def script_name(command: Sequence[str]) -> str:
    """Return the file name of the script."""
    return next((Path(word).name for word in command if word != "-m"), "")


def report(gate: SkipGate, adapter: AbstractAdapter) -> None:
    """Write the report, even if the run failed half-way. Do nothing if no iteration ran."""
    if gate.stats()["iterations"] == 0:
        return
    path = Path(adapter.output_folder or ".") / "skipgs.json"
    try:
        show(gate.summary())
        write_report(gate, path)
    except WriteError as error:
        say(str(error))
    except Exception as error:  # the model is trained, so the script's exit code stands
        say(f"{path} could not be written ({type(error).__name__}: {error}).")


@contextlib.contextmanager
def cpu_instead_of_cuda(args: Args, command: Sequence[str]) -> Iterator[None]:
    """Let the script run as if it had CUDA.

    Raises:
        SkipGSError: There are no stand-ins for the CUDA modules of this trainer.
    """
    family = get_adapter(args.adapter).stand_ins_for(command)
    if family not in FAMILIES:
        raise SkipGSError(
            f"--cpu has no stand-in for the rasterizer of {args.adapter!r}: run {script_name(command)} with CUDA, "
            "without --cpu."
        )
    with serve(family), cuda_on_cpu(), exclusive_cores(), freed_memory_kept(), instead_of_torchs_adam():
        yield
