"""What an adapter is: one trainer's answers."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import torch

from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.clock import Times
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.hooks import Hooks


class AbstractAdapter(ABC):
    """Knows one trainer: what its iteration, view, backward and end of densification are called.

    It holds no loop and decides nothing. It tells the gate through `Hooks`
    - once, `ready(TrainerFacts(start_iter, ...))`, at attach or at the latest before the first iteration;
    - per iteration `iteration(step)`, `view(key)`, and the backward (`gate_tensor_backward`, or a wrapped
      method that calls `backward(loss, run)`);
    - per structural change `event(kind)`.

    Args:
        trainer: The object, module or function to attach to; None for a script that is about to run.

    Attributes:
        name: how users call it.
        project: its name and home, in Markdown, for docs/adapters.md; as are the next two.
        gated: from when on the gate decides, and what pauses it.
        thinned: what `share` does to densification, or why nothing; empty where the declared events say it.
        left_alone: what else is done or left alone in skipped iterations, beyond what holds for every trainer.
        stand_ins: which of the stand-ins of `skipgs_plug.compat` serve the CUDA modules that its scripts import, for
            `--cpu`; empty where there are none.
        checked: upstream version or commit that it was checked with, and in brackets how; part of error messages.
        saved_state: gives the state of the gate that belongs to the checkpoint which the trainer goes on from,
            if any; called once, with the first iteration. Set before the gate is made.
        output_folder: where the trainer writes, as far as it is known.
        released: why the gate let go of a run that then trained on without it; None where it did not.
        replaced: names that whoever runs the trainer has replaced around it, for `SkipGate.patched`. Set before the
            gate is made.
    """

    name: ClassVar[str]
    checked: ClassVar[str]
    project: ClassVar[str] = ""
    gated: ClassVar[str] = ""
    thinned: ClassVar[str] = ""
    left_alone: ClassVar[str] = ""
    stand_ins: ClassVar[str] = ""
    saved_state: Callable[[int], dict[str, Any] | None] | None = None
    output_folder: str | None = None
    released: str | None = None
    replaced: Sequence[str] = ()

    def __init__(self, trainer: Any = None) -> None:
        self.trainer = trainer

    @classmethod
    @abstractmethod
    def matches(cls, trainer: Any) -> bool:
        """Whether this is the trainer that the adapter knows. Imports nothing of it."""

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        """Whether a training script with these names is of the trainer that the adapter knows."""
        return False

    @classmethod
    def stand_ins_for(cls, command: Sequence[str]) -> str:
        """Which stand-ins serve a script with this command line; see `stand_ins`."""
        return cls.stand_ins

    @abstractmethod
    def attach(self, hooks: Hooks) -> None:
        """Hold on to `self.trainer`, which exists and has not begun training.

        Raises:
            AdapterMismatchError: An expected name is missing.
        """

    def attach_script(self, hooks: Hooks) -> None:
        """Hold on to a training script that is about to run in this process.

        Its file is `sys.argv[0]`, its folder is first on `sys.path`, and none of its modules is imported yet.
        """
        raise SkipGSError(f"Adapter {self.name!r} needs a trainer object; it has no script to run.")

    def attach_on_call(self, hooks: Hooks, owner: Any, method: str) -> None:
        """Attach to the object that `owner.method` is called on, before it runs."""

        def begins(original: Callable[..., Any], trainer: Any, *args: Any, **kwargs: Any) -> Any:
            self.trainer = trainer
            with released_on_error(hooks, self):
                self.attach(hooks)
            return original(trainer, *args, **kwargs)

        hooks.wrap(owner, method, begins)

    def must_run(self, step: int) -> bool:
        """Whether skipping is forbidden in this iteration, whose loss is not to be recorded either."""
        return False

    def optimizers(self) -> Iterable[torch.optim.Optimizer]:
        """Optimizers whose learning rates may be scaled, where the trainer knows them; see `Hooks.own_loop`."""
        return ()

    def timing(self) -> Times | None:
        """Seconds of training, when the trainer keeps them itself."""
        return None


def gate_backwards_only(hooks: Hooks, adapter: AbstractAdapter) -> None:
    """Refuse settings that leave out whole iterations, for a trainer whose loop is not counted with a range.

    Raises:
        SkipGSError: There are such settings.
    """
    if hooks.state.pace.leaves_out:
        raise SkipGSError(
            f"Adapter {adapter.name!r} cannot leave out whole iterations, since its trainer's loop does not count with "
            "range(): leave out share and refine_share, and it gates backwards as in the paper."
        )


def release(hooks: Hooks, adapter: AbstractAdapter, reason: str) -> None:
    """Take the gate off a run that goes on without it, and say why: an error would throw away what was trained."""
    hooks.restore()
    adapter.released = reason
    warnings.warn(reason, RuntimeWarning, stacklevel=3)


@contextmanager
def released_on_error(hooks: Hooks, adapter: AbstractAdapter) -> Iterator[None]:
    """Release the gate when the adapter's own code fails, so that no run is lost to it.

    A refusal ends the script, as long as nothing is trained; of a gate that is off, it ends nothing at all.

    Raises:
        SkipGSError: The gate is on, and refuses this run in its first iteration.
    """
    trained = hooks.trained
    try:
        yield
    except Exception as error:
        if isinstance(error, SkipGSError) and hooks.state.config.enabled and not trained:
            raise
        name = "" if isinstance(error, SkipGSError) else f"{type(error).__name__}: "
        release(hooks, adapter, f"The gate is released, and training goes on without it: {name}{error}")


def guarded(hooks: Hooks, adapter: AbstractAdapter, call: Callable[..., Any]) -> Callable[..., None]:
    """Return `call` as a function that releases the gate when it fails; see `released_on_error`."""

    def safe(*args: Any, **kwargs: Any) -> None:
        with released_on_error(hooks, adapter):
            call(*args, **kwargs)

    return safe


# Marks a `torch.multiprocessing.spawn` that attaches a gate in each process.
GATES_SPAWNED = "__skipgs_gates_spawned__"


def refuse_other_processes(hooks: Hooks) -> None:
    """Let a script fail that is about to spread training over several processes, where no gate is attached."""

    def spawned(fn: Any, args: Any = (), nprocs: int = 1, *more: Any, **options: Any) -> None:
        raise SkipGSError(
            f"The script starts {nprocs} processes, which the gate cannot reach; train in one, for example with "
            "CUDA_VISIBLE_DEVICES=0."
        )

    hooks.before(torch.multiprocessing, "spawn", spawned)
