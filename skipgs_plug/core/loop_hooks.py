"""Facts about the training loop that an adapter passes to a gate, so that the gate can leave out whole iterations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from skipgs_plug.core.engine import Engine
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.name_hooks import NameHooks
from skipgs_plug.core.optimizers import Named, Optimizers
from skipgs_plug.core.pace.base import Always, Known, nothing_always, nothing_known
from skipgs_plug.core.pace.loop_range import LoopRange, replace_range
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.pace.schedulers import catch_up_schedulers
from skipgs_plug.core.trainer_info import Densification


class LoopHooks(NameHooks):
    """The part of `Hooks` about iterations that are left out, and about larger steps that make up for them.

    Args:
        engine: Engine of the gate.
        optimizers: Returns the optimizers of the training loop.
        patches: List of replacements in the trainer.
    """

    def __init__(self, engine: Engine, optimizers: Optimizers, patches: Patches) -> None:
        super().__init__(patches)
        self._engine = engine
        self._optimizers = optimizers

    def loop(
        self,
        names: dict[str, Any],
        *functions: str,
        always: Always | None = None,
        pure: Iterable[str] = (),
        densification: Densification | None = None,
        known: Known | None = None,
    ) -> None:
        """Name the functions whose loop over `range` may be the training loop, so that iterations can be left out.

        Iterations that the loop's own conditions name (`if iteration % 1000 == 0`) always run. Learning-rate schedulers
        of PyTorch are kept where they would be if all iterations ran.

        Args:
            names: Global names of the functions' module; `script_globals` for a script that is about to run.
            functions: Names of the functions.
            always: Returns further iterations out of a range that must run, because functions that the loop calls
                depend on their numbers.
            pure: Functions that only read numbers, and may occur in the loop's conditions.
            densification: How to recognise densification events, if `ready` comes after the loop has begun.
            known: Receives all names of the loop's function right before its conditions are read, and returns values
                of names that the loop assigns, if they are known before.

        Raises:
            SkipGSError: In training, at the first number that can be left out: a condition of the loop cannot be
                evaluated ahead, or no loop counts the iterations.
        """
        pace = self._engine.pace
        if isinstance(pace, Phased):
            pace.describe(always or nothing_always, pure, densification, known or nothing_known, functions)
            replace_range(self._patches, names, functions, pace)
            catch_up_schedulers(self._patches, pace)

    def always(self, always: Always) -> None:
        """Name iterations that must run, if the loop is the user's own.

        Args:
            always: Returns the iterations out of a range that must run, as for `loop`.
        """
        self._engine.pace.describe(always)

    def require(self, number: int) -> None:
        """Make an iteration run, because a condition of the loop depends on a change that just happened.

        Give the name in such a condition a value for which it never holds; see `known` of `loop`.

        Args:
            number: The iteration, later than the present one.
        """
        self._engine.pace.require(number)

    def optimizer_names(self, named: Named) -> None:
        """Tell which optimizers the trainer has. Only their learning rates are scaled.

        Args:
            named: Returns the optimizers by name. The name of an optimizer identifies its groups if they have none.
        """
        self._engine.rates.only = named

    def own_loop(self, owner: Any, name: str, always: Always | None = None) -> None:
        """Use the range that `owner.name(...)` returns as that of the training loop.

        Only the learning rates of the adapter's `optimizers` are scaled.

        Args:
            owner: The object or class that holds the function, as for `wrap`.
            name: Attribute of the function, which returns a range with step 1.
            always: Returns the iterations out of a range that must run, as for `loop`.

        Raises:
            AdapterMismatchError: The owner has no function of this name.
        """
        self._engine.rates.only = self._optimizers
        pace = self._engine.pace
        if not pace.leaves_out:
            return
        pace.describe(always or nothing_always)

        def counted(original: Callable[..., range], *args: Any, **kwargs: Any) -> LoopRange:
            return pace.follow(original(*args, **kwargs), None)

        self._patches.wrap(owner, name, counted)

    def number(self, counted: int) -> int:
        """Return the number of the present iteration in the training loop.

        Args:
            counted: Number to return while that loop is not known.
        """
        number = self._engine.pace.number
        return counted if number is None else number

    @property
    def may_halve(self) -> bool:
        """Whether the settings allow photographs of half the size, if the adapter can show them."""
        return self._engine.config.may_halve

    @property
    def at_half_size(self) -> bool:
        """Whether the present iteration must train on a photograph of half the width and height."""
        return self._engine.pace.at_half_size

    @property
    def gap(self) -> int:
        """Number of iterations that were left out right before the present one."""
        return self._engine.pace.gap
