"""The base class of adapters: everything that the gate must know about one trainer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch

from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.clock import Times
from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError
from skipgs_plug.core.hooks import Hooks


class AbstractAdapter(ABC):
    """Knows one trainer: the names of its iteration, view, backward pass and end of densification.

    An adapter has no loop and makes no decisions. It reports to the gate through `Hooks`:

    - once: `ready(TrainerInfo(start_iter, ...))`, at attach or before the first iteration;
    - in each iteration: `iteration(step)`, `view(key)`, and the backward pass (`gate_tensor_backward`, or a wrapped
      method that calls `backward(loss, run)`);
    - for each structural change: `event(kind)`.

    Args:
        trainer: The object, module or function to attach to; None for a script that is about to run.

    Attributes:
        name: The name by which users choose the adapter.
        project: Name and home page of the trainer, in Markdown. `project`, `gated`, `with_share` and `left_alone` are
            text of docs/adapters.md.
        gated: First iteration that the gate may skip, and the changes that pause it.
        with_share: Effect of `share` on densification, or why it has no effect. Empty if the declared events imply it.
        left_alone: Behaviour in skipped iterations, beyond the rules for every trainer.
        stand_ins: Family of stand-ins in `skipgs_plug.compat` for the CUDA modules of its scripts, for `--cpu`. Empty
            if there is no such family.
        checked: Upstream version or commit of the check and, in brackets, its kind. Part of error messages.
        saved_state: Returns the gate's state of the checkpoint from which the trainer continues, if any. It is called
            once, with the first iteration. Set it before the gate is created.
        output_folder: The trainer's output folder, if known.
        script: File that holds the training loop, if it is not `sys.argv[0]`. Set it before the gate is created.
        replaced: Names that the launcher has replaced around the trainer, for `SkipGate.patched`. Set it before the
            gate is created.
    """

    name: ClassVar[str]
    checked: ClassVar[str]
    project: ClassVar[str] = ""
    gated: ClassVar[str] = ""
    with_share: ClassVar[str] = ""
    left_alone: ClassVar[str] = ""
    stand_ins: ClassVar[str] = ""
    saved_state: Callable[[int], dict[str, Any] | None] | None = None
    output_folder: str | None = None
    script: Path | None = None
    replaced: Sequence[str] = ()

    def __init__(self, trainer: Any = None) -> None:
        self.trainer = trainer

    @classmethod
    @abstractmethod
    def matches(cls, trainer: Any) -> bool:
        """Return whether this is the trainer that the adapter knows, without importing the trainer.

        Args:
            trainer: An object, a module or a function.
        """

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        """Return whether a training script belongs to the trainer that the adapter knows.

        Args:
            code: Names that the script has and that its loop uses.
        """
        return False

    @classmethod
    def stand_ins_for(cls, command: Sequence[str]) -> str:
        """Return the family of stand-ins for a script; see `stand_ins`.

        Args:
            command: Command line of the script.
        """
        return cls.stand_ins

    @abstractmethod
    def attach(self, hooks: Hooks) -> None:
        """Attach to `self.trainer`, which has not begun training.

        Args:
            hooks: Reports to the gate, and replaces names in the trainer.

        Raises:
            AdapterMismatchError: An expected name is missing.
        """

    def attach_script(self, hooks: Hooks) -> None:
        """Attach to a training script that is about to run in this process.

        Its file is `script` or `sys.argv[0]`. Its folder is first on `sys.path`, and none of its modules is imported.

        Args:
            hooks: Reports to the gate, and replaces names in the trainer.

        Raises:
            SkipGSError: The trainer has no script, or its script cannot be gated.
        """
        raise SkipGSError(f"Adapter {self.name!r} needs a trainer object; it has no script to run.")

    def attach_on_call(self, hooks: Hooks, owner: Any, method: str) -> None:
        """Attach to the object that a method is called on, before it runs. A second call releases the gate.

        Classes that derive from the owner may override the method. A script that trains without calling it is refused.

        Args:
            hooks: Reports to the gate, and replaces names in the trainer.
            owner: The class of the object.
            method: Name of the method.

        Raises:
            AdapterMismatchError: The class has no such method.
        """
        call = f"call of {owner.__name__}.{method}()"

        def begins(original: Callable[..., Any], trainer: Any, *args: Any, **kwargs: Any) -> Any:
            hooks.awaited.discard(call)
            if self.trainer is not None:
                hooks.release(
                    "The gate is released: a second training run begins in this process. Training goes on without it, "
                    "in all its iterations."
                )
                return original(*args, **kwargs)
            self.trainer = trainer
            with hooks.guarded():
                self.attach(hooks)
            return original(*args, **kwargs)

        def created(original: Callable[..., Any], trainer: Any, *args: Any, **kwargs: Any) -> Any:
            original(trainer, *args, **kwargs)
            if method not in vars(trainer):
                hooks.wrap(trainer, method, lambda run, *args, **kwargs: begins(run, trainer, *args, **kwargs))

        if not callable(getattr(owner, method, None)):
            raise self.mismatch(f"a class {owner.__name__} with a method {method}()")
        hooks.awaited.add(call)
        for kind in {owner, *derived(owner)}:
            if kind is owner or "__init__" in vars(kind):  # such a one need not call that of its parent
                hooks.wrap(kind, "__init__", created)

    def mismatch(self, expected: str) -> AdapterMismatchError:
        """Return the error for a trainer that differs from the one that the adapter knows.

        Args:
            expected: What the adapter expects. It completes the sentence "Adapter ... expects".
        """
        return AdapterMismatchError(f"Adapter {self.name!r} expects {expected}, as in {self.checked}.")

    def must_run(self, step: int) -> bool:
        """Return whether the backward pass of an iteration must not be skipped. Its loss is not recorded either.

        Args:
            step: Number of the iteration, counted as the trainer counts.
        """
        return False

    def optimizers(self) -> Iterable[torch.optim.Optimizer]:
        """Return the optimizers whose learning rates may be scaled, if the trainer knows them; see `Hooks.own_loop`."""
        return ()

    def timing(self) -> Times | None:
        """Return the seconds of training, if the trainer measures them itself."""
        return None


def derived(owner: type) -> Iterator[type]:
    """Return all classes that derive from a class, and exist already."""
    children: list[type] = owner.__subclasses__()
    for kind in children:
        yield kind
        yield from derived(kind)


def gate_backwards_only(hooks: Hooks, adapter: AbstractAdapter) -> None:
    """Refuse settings that leave out whole iterations, for a trainer whose loop does not count with a range.

    Args:
        hooks: Reports to the gate.
        adapter: The adapter that attaches it.

    Raises:
        SkipGSError: There are such settings.
    """
    if hooks.state.pace.leaves_out:
        raise SkipGSError(
            f"Adapter {adapter.name!r} cannot leave out whole iterations, since its trainer's loop does not count with "
            "range(); give neither share nor refine_share, and it gates backward passes as in the paper."
        )


# Marks a `torch.multiprocessing.spawn` that attaches a gate in each process.
GATES_SPAWNED = "__skipgs_gates_spawned__"


def refuse_other_processes(hooks: Hooks) -> None:
    """Refuse a script that is about to start several processes, since no gate is attached in them."""

    def spawned(fn: Any, args: Any = (), nprocs: int = 1, *more: Any, **options: Any) -> None:
        raise SkipGSError(
            f"The script starts {nprocs} processes, which the gate cannot reach; train in one process, for example "
            "with CUDA_VISIBLE_DEVICES=0."
        )

    hooks.before(torch.multiprocessing, "spawn", spawned)
