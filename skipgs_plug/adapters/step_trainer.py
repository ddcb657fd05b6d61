"""The pip package `gaussian-splatting`: trainers with `step(camera)`, wrapped around each other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from types import FunctionType
from typing import Any

import torch

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.caution import caution
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import Densification, TrainerInfo

MODULE, STEP = "gaussian_splatting.prepare", "step"

# Attributes of the outermost trainer that `step` or this adapter uses.
EXPECTED = ("step", "curr_step", "optimizer", "update_learning_rate", "preprocess", "before_optim_hook", "optim_step")
# End of the names of attributes that hold the last iteration (inclusive) with a change, and such names of the package.
BOUND = "_until_iter"
BOUNDS = ("densify_until_iter", "prune_until_iter", "opacity_reset_until_iter")
RAISES = "sh_degree_up_interval"  # attribute of the wrapper that raises the SH degree
# Attribute of the wrapper that prunes, among others by the largest size that a Gaussian had on the screen in any step.
SIZE = "prune_screensize_threshold"
# Least number of iterations with prunes by the size on the screen, if some of them may be left out. With longer steps,
# sizes overshoot. In 3,000 iterations, of which 1,500 prune, the script lost 1.1 dB on fern from one of two draws of
# the points. In 12,000, of which 6,000 prune, it gained 0.9 dB on bonsai.
ENOUGH_PRUNES_BY_SIZE = 6000


class StepTrainer(AbstractAdapter):
    """One `step(camera)`: learning rates, forward, loss, backward, `before_optim_hook`, `optim_step`.

    Everything but the backward and the hook that reads gradients keeps running: `loss` raises the SH degree, and
    `optim_step` resets opacities. A reset replaces a parameter in the optimizer. The last reset is in the last
    iteration of densification, right before the gate begins.
    """

    name = "step_trainer"
    checked = "gaussian-splatting 2.11.0 of PyPI (its script run)"
    project = "[pip gaussian-splatting](https://pypi.org/project/gaussian-splatting/)"
    gated = (
        "From the last of its `_until_iter` bounds + 1 on, after a pause for the opacity reset on that bound. "
        "Modes without densification need `--start-iter`."
    )
    with_share = (
        "By visits, if `prune_until_iter` >= 6,000 and no wrapper of yours reads `curr_step`; else densification runs "
        "whole. Your own loop can name events (`gate.iterations(..., events=...)`)."
    )
    left_alone = (
        "`before_optim_hook`, which reads gradients, is left out with the backward. Attach to the outermost trainer. "
        "You may add wrappers later."
    )
    stand_ins = "pip_gaussian_splatting"

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._views: list[Any] | None = None  # paths of the training photographs; a trainer object does not tell them

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return "prepare_trainer" in code.names

    def attach_script(self, hooks: Hooks) -> None:
        def prepared(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            options = sys._getframe(2).f_globals.get("args")  # frame 2 is the script's
            self.output_folder = getattr(options, "destination", None)
            self.trainer = original(*args, **kwargs)
            dataset = kwargs.get("dataset", args[1] if len(args) > 1 else None)
            if dataset is not None:
                self._views = [dataset[index].ground_truth_image_path for index in range(len(dataset))]
            self.attach(hooks)
            return self.trainer

        hooks.gate_tensor_backward(STEP)
        # `python -m gaussian_splatting.train` binds this name after the import.
        when_imported(hooks, MODULE, lambda module: hooks.wrap(module, "prepare_trainer", prepared))
        hooks.loop(hooks.script_globals, "training")

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        missing = [name for name in EXPECTED if not hasattr(trainer, name)]
        if missing:
            raise self.mismatch(f"a trainer with {', '.join(missing)}")

        bounds = {name: getattr(part, name) for part in layers(trainer) for name in dir(part) if name.endswith(BOUND)}
        end = max(bounds.values()) + 1 if bounds else None
        if unknown := sorted(bounds.keys() - set(BOUNDS)):
            caution(
                f"The trainer does more than {self.checked.partition(' (')[0]}, which adapter {self.name!r} is for. "
                f"Not recognised: {', '.join(unknown)}. The gate begins with iteration {end}, after the last bound."
            )

        unread = counting_methods(trainer) if hooks.state.pace.leaves_out else []
        if unread and hooks.state.config.always is None:
            caution(
                f"It is not known which iterations need {', '.join(unread)}: reads of curr_step outside the package "
                "are not evaluated ahead; name the iterations (--always, always=), or they may be left out."
            )

        def watched(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            if end is not None and trainer.curr_step < end - 1:
                return original(*args, **kwargs)
            before = parameters(trainer.optimizer)
            result = original(*args, **kwargs)
            after = parameters(trainer.optimizer)
            if len(before) != len(after) or any(one is not two for one, two in zip(before, after, strict=True)):
                hooks.event("parameters replaced")
            return result

        def hooked(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return None if hooks.state.skipped else watched(original, *args, **kwargs)

        def advanced(original: Callable[[], None]) -> None:
            for _ in range(hooks.gap):  # the trainer counts its calls
                original()
            hooks.iteration(trainer.curr_step + 1)
            original()

        # Wrappers that are added later call all of these methods, but not `step`.
        hooks.wrap(trainer, "update_learning_rate", advanced)
        hooks.always(self.always_run)
        hooks.before(trainer, "preprocess", lambda camera: hooks.view(camera.ground_truth_image_path))
        hooks.wrap(trainer, "before_optim_hook", hooked)
        hooks.wrap(trainer, "optim_step", watched)
        hooks.gate_tensor_backward(STEP)
        hooks.check_drift(lambda: [trainer.optimizer])
        known = end is not None and not unknown and not unread
        hooks.ready(
            TrainerInfo(
                end,
                view_names=self._views,
                gradients_read_until=end,
                densification=self.densification if known else None,
            )
        )

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return the iterations that raise the SH degree, reset opacities, or prune by size in a short schedule."""
        by_size = [part.prune_until_iter for part in layers(self.trainer) if hasattr(part, SIZE)]
        short = max((last for last in by_size if last < ENOUGH_PRUNES_BY_SIZE), default=-1)
        raises = [part.sh_degree_up_interval for part in layers(self.trainer) if hasattr(part, RAISES)]
        resets = scheduled(self.trainer, "opacity_reset", numbers)
        return (n for n in numbers if n <= short or n in resets or any(n % interval == 0 for interval in raises))

    @property
    def densification(self) -> Densification:
        """The iterations in which Gaussians are added or pruned, and those in which opacities are reset."""

        def events(numbers: range) -> Iterable[int]:
            return sorted(scheduled(self.trainer, "densify", numbers) | scheduled(self.trainer, "prune", numbers))

        return Densification(
            numbers=events, reset_numbers=lambda numbers: scheduled(self.trainer, "opacity_reset", numbers)
        )


def scheduled(trainer: Any, kind: str, numbers: range) -> set[int]:
    """Return the iterations in which a layer acts, from its `<kind>_from_iter`, `_until_iter` and `_interval`."""
    found: set[int] = set()
    for part in layers(trainer):
        if hasattr(part, kind + BOUND):
            first, last, every = (getattr(part, kind + end) for end in ("_from_iter", BOUND, "_interval"))
            found.update(n for n in numbers if first <= n <= last and n % every == 0)
    return found


def layers(part: Any) -> Iterator[Any]:
    """Yield a trainer and all trainers and densifiers inside it."""
    yield part
    for name in ("base_trainer", "densifier", "base_densifier"):
        if hasattr(part, name):
            yield from layers(getattr(part, name))


def counting_methods(trainer: Any) -> list[str]:
    """Return the methods of users' own layers that read the iteration, and so may save or prune in certain ones."""
    kinds = [kind for part in reversed([*layers(trainer)]) for kind in reversed(type(part).__mro__)]
    found = {kind: methods for kind in kinds if (methods := readers(kind))}
    packages = [kind.__module__.partition(".")[0] for kind in found]  # the base class of the innermost trainer is first
    own = (kind for kind, package in zip(found, packages, strict=True) if package != packages[0])
    return sorted(f"{kind.__name__}.{name}()" for kind in own for name in found[kind])


def readers(kind: type) -> list[str]:
    """Return the names of the methods that a class defines and that read the iteration."""
    methods = ((name, one) for name, one in vars(kind).items() if isinstance(one, FunctionType))
    return [name for name, method in methods if "curr_step" in method.__code__.co_names]


def parameters(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
