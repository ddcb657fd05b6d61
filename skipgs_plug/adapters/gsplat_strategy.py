"""gsplat's densification strategies, which gsplat's own script and nerfstudio use."""

from __future__ import annotations

import ast
import functools
import sys
from collections.abc import Callable, Iterable
from types import FunctionType
from typing import Any

from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.hooks import Adapter, Hooks
from skipgs_plug.core.source.functions import syntax_of, undecorated
from skipgs_plug.core.trainer_info import Densification

OPERATIONS = "gsplat.strategy.ops"  # module of the functions by which strategies change the model
CHANGES = (
    "_add_new_gs",
    "_grow_gs",
    "_prune_gs",
    "_relocate_gs",
    "duplicate",
    "relocate",
    "remove",
    "reset_opa",
    "sample_add",
    "split",
)
# Further methods of a strategy, and functions, that change no parameters: noise is left out with the gradient step.
KNOWN = ("check_sanity", "initialize_state", "inject_noise_to_position")
STAGES = ("step_pre_backward", "step_post_backward", "_update_state")
Resets = Callable[[int], bool]


def survey_of(adapter: Adapter, loop: str, strategy: Any, *owners: Any, through: Iterable[str] = ()) -> Survey:
    """Return a survey of calls by which a strategy, or more owners of the model, change it; see `Survey`.

    `loop` is the name of the method that calls the training backward.
    """
    operations = [sys.modules[OPERATIONS]] if OPERATIONS in sys.modules else []
    return Survey(adapter, [type(strategy), *operations, *owners], KNOWN, CHANGES, [loop], [*STAGES, *through])


def is_mcmc(strategy: Any) -> bool:
    """Whether the strategy moves Gaussians at random in every iteration until the end of the run."""
    return hasattr(strategy, "noise_lr")


def first_iterations(survey: Survey, strategy: Any, last: int) -> tuple[int | None, int]:
    """Return the first iteration that the gate may skip, and the first one whose gradients nothing reads.

    Strategies of others, and models that densify by themselves (nerfstudio before 1.1.5), may have no
    `refine_stop_iter`, or read gradients for longer.

    Args:
        survey: The survey, which has read the trainer.
        strategy: The strategy; None if the model densifies by itself.
        last: Last iteration of the run.

    Returns:
        Both. The first is None if it is not known, and the second is 0 if gradients are never read.

    Raises:
        AdapterMismatchError: Gradients are read until the end of the run, or the end of densification moves.
    """
    stop = getattr(strategy, "refine_stop_iter", None)
    read_until = survey.end_of_gradients(0 if stop is None else int(stop), last)
    if stop is not None and not is_mcmc(strategy):
        read_until = max(int(stop), read_until)
    start = read_until or None if stop is None else int(stop)
    return (None if start is None else survey.start_after_changes(start, last)), read_until


def strategy_events(strategy: Any, resets: Resets | None = None) -> Densification | None:
    """Return the densification events of a strategy; None without one that names them as gsplat's do.

    MCMC adds a constant share of Gaussians per event, so all of its events are kept.

    Args:
        strategy: The strategy.
        resets: Whether an iteration resets opacities; by default as in the strategy's source.
    """
    first, every = getattr(strategy, "refine_start_iter", 0), getattr(strategy, "refine_every", None)
    if every is None:
        return None
    mcmc = is_mcmc(strategy)
    reset, pause = getattr(strategy, "reset_every", every), getattr(strategy, "pause_refine_after_reset", 0)

    def acts(n: int) -> bool:
        return n > first and n % every == 0 and (mcmc or n % reset >= pause)

    return Densification(
        numbers=lambda numbers: filter(acts, numbers),
        needs="nothing" if mcmc else "visits",
        resets=not mcmc,
        reset_numbers=None if mcmc else lambda numbers: filter(resets or resets_of(strategy), numbers),
    )


def iterations_that_run(strategy: Any, numbers: range, resets: Resets | None = None) -> Iterable[int]:
    """Return the iterations until densification ends that must all run; arguments as for `strategy_events`.

    They reset opacities, or Gaussians are split in them by the largest size that they had on the screen in any step
    (`refine_scale2d_stop_iter`, nerfstudio's default). With fewer, longer steps sizes overshoot: splatfacto ended with
    172 % of its Gaussians on fern, and 0.2 dB below its own run.
    """
    stop = getattr(strategy, "refine_stop_iter", 0)
    by_size = getattr(strategy, "refine_scale2d_stop_iter", 0)
    resets = resets or resets_of(strategy)
    return (n for n in numbers if n < min(stop, by_size) or resets(n))


def resets_of(strategy: Any) -> Resets:
    """Return whether an iteration resets opacities: by the source of a strategy, else by its settings."""
    every, stop = getattr(strategy, "reset_every", 0), getattr(strategy, "refine_stop_iter", 0)
    holds = _reset_condition(undecorated(getattr(strategy, "step_post_backward", None)))
    if holds is None:
        return lambda n: 0 < n < stop and bool(every) and n % every == 0
    return lambda n: 0 < n < stop and holds(strategy, n)


@functools.cache
def _reset_condition(method: FunctionType | None) -> Callable[[Any, int], bool] | None:
    """Return the condition under which a strategy's method resets opacities; None if it cannot be read.

    The settings do not tell it: gsplat 1.5.3 tests `step % self.reset_every == 0 & step > 0`, which Python reads as
    `step % self.reset_every == (0 & step) > 0`. So it never resets opacities.
    """
    syntax = None if method is None else syntax_of(method)
    if syntax is None:
        return None
    tests = [node.test for node in ast.walk(syntax) if isinstance(node, ast.If) and _resets_in(node)]
    parts = [part for test in tests for part in ast.walk(test)]
    names = {part.id for part in parts if isinstance(part, ast.Name)}
    if not tests or not names <= {"self", "step"} or any(isinstance(part, ast.Call) for part in parts):
        return None
    return eval(f"lambda self, step: {' and '.join(f'({ast.unparse(test)})' for test in tests)}")


def _resets_in(branch: ast.If) -> bool:
    """Whether a branch resets opacities."""
    calls = (part for line in branch.body for part in ast.walk(line) if isinstance(part, ast.Call))
    return any(isinstance(call.func, ast.Name) and call.func.id == "reset_opa" for call in calls)


def leave_out_noise(hooks: Hooks, strategy: Any, owner: Any) -> range:
    """Leave out MCMC's noise together with the gradient step: alone it is a random walk.

    The rate of the noise is zero in a skipped iteration. What else the method of a strategy does happens as ever.

    Args:
        hooks: Hooks of the trainer.
        strategy: The strategy; nothing happens unless it is MCMC.
        owner: Where to replace `step_post_backward`: the strategy, or its class.

    Returns:
        Iterations that must not be skipped, because they relocate. They matter only to a gate that starts before
        relocation ends.
    """
    if not is_mcmc(strategy):
        return range(0)

    def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        rate = strategy.noise_lr
        if hooks.state.skipped:
            strategy.noise_lr = 0.0
        try:
            return original(*args, **kwargs)
        finally:
            strategy.noise_lr = rate

    hooks.wrap(owner, "step_post_backward", around)
    return range(0, getattr(strategy, "refine_stop_iter", 0), getattr(strategy, "refine_every", 1))
