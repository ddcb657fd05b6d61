"""`torch.optim.Adam` on all cores: as a class, and as a replacement for the function that torch's class calls."""

import importlib
import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from ..runtime.function_modes import without_function_modes
from .adam import adam_step

ADAM_REPLACED = "torch.optim.adam.adam"
"""Name of the function that `torch.optim.Adam` calls in each step, which `instead_of_torchs_adam` replaces."""
# Most elements of a parameter that the kernel steps, because it indexes them in 32 bits. Torch steps larger parameters.
MAX_NUMBERS = 2**30
# Options of torch's Adam that only torch's function supports, and all options of a group of parameters but `betas`.
_UNSUPPORTED_OPTIONS = ("amsgrad", "maximize", "weight_decay", "capturable", "differentiable", "has_complex")
_GROUP_OPTIONS = (*_UNSUPPORTED_OPTIONS[:-1], "lr", "eps", "foreach", "fused", "decoupled_weight_decay")

# Imported by name, because torch.optim deletes its attribute for the module.
_module: Any = importlib.import_module("torch.optim.adam")
_torchs_adam = _module.adam
_torchs_base: Any = importlib.import_module("torch.optim.optimizer")


class Adam(torch.optim.Adam):
    """`torch.optim.Adam` that steps with `adam` below. Options, state, state_dict and hooks are those of torch.

    Example:
        >>> import torch
        >>> means = torch.nn.Parameter(torch.zeros(100, 3))
        >>> optimizer = Adam([means], lr=0.01, eps=1e-15)
        >>> (means - 1.0).square().sum().backward()
        >>> optimizer.step()
        >>> round(means[0, 0].item(), 4)
        0.01
    """

    # Torch wraps these two methods, and its wrapper loads torch's compiler: 75 MB and 800 modules that training does
    # not use.

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group of parameters, as torch's optimizers do."""
        inspect.unwrap(torch.optim.Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Reset all gradients, as torch's optimizers do."""
        if not set_to_none:
            inspect.unwrap(torch.optim.Optimizer.zero_grad)(self, set_to_none)
            return
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    def step(self, closure: Any = None) -> Any:  # type: ignore[override]
        """Update every parameter that has a gradient.

        Args:
            closure: Function that recomputes and returns the loss, as for torch's optimizers.

        Returns:
            The loss that `closure` returns; None without a closure.
        """
        if torch.autograd._profiler_enabled():
            return self._profiled_step(closure)
        # Call hooks as torch's wrapper does, but without the record for a profiler that it makes even when none runs.
        given: tuple[Any, Any] = (self,) if closure is None else (self, closure), {}
        for hook in (*_torchs_base._global_optimizer_pre_hooks.values(), *self._optimizer_step_pre_hooks.values()):
            given = hook(self, *given) or given
        args, kwargs = given
        loss = self._plain_step(*args[1:], **kwargs)
        for hook in (*self._optimizer_step_post_hooks.values(), *_torchs_base._global_optimizer_post_hooks.values()):
            hook(self, args, kwargs)
        return loss

    # Keeps torch from wrapping this method for hooks and profiler: the wrapper takes as long as a small step.
    step.hooked = True  # type: ignore[attr-defined]

    def _plain_step(self, closure: Any = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        with torch.set_grad_enabled(self.defaults["differentiable"]):
            for group in self.param_groups:
                self._step(group)
        return loss

    _profiled_step = torch.optim.Optimizer.profile_hook_step(_plain_step)

    def _step(self, group: dict[str, Any]) -> None:
        grad_scale, found_inf = getattr(self, "grad_scale", None), getattr(self, "found_inf", None)
        left = group["params"]
        if grad_scale is None and found_inf is None and _plain(group, *group["betas"]):
            numbers = float(group["lr"]), group["betas"], group["eps"]
            left = [param for param in left if not self._advance_param(param, *numbers)]
        if not left:
            return
        lists: tuple[list[Tensor], ...] = ([], [], [], [], [], [])
        has_complex = self._init_group({**group, "params": left}, *lists)
        _torchs_adam(
            *lists,
            has_complex=has_complex,
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            grad_scale=grad_scale,
            found_inf=found_inf,
            **{name: group[name] for name in _GROUP_OPTIONS if name in group},
        )

    def _advance_param(self, param: Tensor, *numbers: Any) -> bool:
        if param.grad is None:
            return True
        if not self.state.get(param) and not _fits(param, param):  # torch's own step creates the state
            return False
        state = moments(self, param)
        return _advance(param, param.grad, state["exp_avg"], state["exp_avg_sq"], state["step"], *numbers)


def moments(optimizer: torch.optim.Optimizer, param: Tensor) -> dict[str, Tensor]:
    """Return the state of a parameter in an optimizer like `torch.optim.Adam`. A missing state is created as zeros.

    Args:
        optimizer: The optimizer. Its `state` receives the tensors.
        param: One of its parameters.

    Returns:
        `step`, a scalar that counts the steps, and the running means of the gradient, `exp_avg`, and of the squared
        gradient, `exp_avg_sq`, of the shape of the parameter.
    """
    state: dict[str, Tensor] = optimizer.state[param]
    if not state:
        state["step"] = torch.tensor(0.0, dtype=torch.float32)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(param), torch.zeros_like(param)
    return state


def next_step(step: Tensor, lr: float, betas: tuple[float, float]) -> tuple[float, float]:
    """Count a step, and return `rate` and `root` of `adam_step`, which hold the bias corrections of both moments."""
    count = step.item() + 1
    step.fill_(count)  # takes half the time of an addition
    return lr / (1 - betas[0] ** count), (1 - betas[1] ** count) ** 0.5


@without_function_modes
def adam(
    params: Sequence[Tensor],
    grads: Sequence[Tensor],  # of the same shapes
    exp_avgs: Sequence[Tensor],  # of the same shapes
    exp_avg_sqs: Sequence[Tensor],  # of the same shapes
    max_exp_avg_sqs: Sequence[Tensor],
    state_steps: Sequence[Tensor],
    *flags: Any,
    **options: Any,
) -> None:
    """Apply one step of Adam in place, on all cores: a replacement for `torch.optim.adam.adam`. Rounds as `adam_step`.

    Torch's function steps parameters that are not contiguous float32 tensors on the CPU. It also steps all parameters
    if an option other than `lr`, `betas` and `eps` is used: weight decay, amsgrad, maximize, capturable,
    differentiable, or a gradient scaler.

    Args:
        params: Parameters, updated in place.
        grads: Their gradients.
        exp_avgs: Running means of the gradients, updated in place.
        exp_avg_sqs: Running means of the squared gradients, updated in place.
        max_exp_avg_sqs: Largest values of these means so far. Only `amsgrad` uses them; passed on to torch.
        state_steps: Number of steps of each parameter so far, updated in place.
        flags: Further positional arguments of torch's function.
        options: Further keyword arguments of torch's function.
    """
    everything = (params, grads, exp_avgs, exp_avg_sqs, max_exp_avg_sqs, state_steps)
    betas = options["beta1"], options["beta2"]
    scaled = options.get("grad_scale") is not None or options.get("found_inf") is not None
    if flags or scaled or not _plain(options, *betas):
        _torchs_adam(*everything, *flags, **options)
        return
    numbers = float(options["lr"]), betas, options["eps"]
    each = enumerate(zip(params, grads, exp_avgs, exp_avg_sqs, state_steps, strict=True))
    left = [number for number, tensors in each if not _advance(*tensors, *numbers)]
    if left:
        some = ([whole[i] for i in left] if whole else [] for whole in everything)
        _torchs_adam(*some, **options)


@contextmanager
def instead_of_torchs_adam() -> Iterator[None]:
    """Let every `torch.optim.Adam` step with `adam` inside the `with` statement, also those that exist already."""
    before = _module.adam
    _module.adam = adam
    try:
        yield
    finally:
        _module.adam = before


def _plain(options: dict[str, Any], *betas: Any) -> bool:
    """Return whether `adam` supports all options that are set, and the decays are numbers."""
    for name in _UNSUPPORTED_OPTIONS:
        if options.get(name):
            return False
    return not any(isinstance(beta, Tensor) for beta in betas)


def _advance(
    param: Tensor, grad: Tensor, mean: Tensor, square: Tensor, step: Tensor, lr: float, betas: tuple[float, float],
    eps: float,
) -> bool:  # fmt: skip
    """Step a parameter if the kernel can read all its tensors. Returns whether it did. `step` counts earlier steps."""
    # Written out without a generator: for small parameters these checks are most of a step.
    if not (step.is_cpu and _fits(param, param) and _fits(grad, param) and _fits(mean, param) and _fits(square, param)):
        return False
    adam_step(None, param, grad, mean, square, *next_step(step, lr, betas), betas, eps)
    return True


def _fits(tensor: Tensor, param: Tensor) -> bool:
    """Return whether the kernel can read a tensor together with its parameter."""
    return (
        tensor.dtype is torch.float32
        and tensor.layout is torch.strided
        and tensor.is_cpu
        and tensor.is_contiguous()
        and tensor.shape == param.shape
        and tensor.numel() <= MAX_NUMBERS
        and (tensor.data_ptr() != 0 or tensor.numel() == 0)
    )
