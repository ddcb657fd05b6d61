"""`torch.optim.Adam` on all cores, as a class of its own and in place of torch's function."""

import importlib
import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from .adam import adam_step

REPLACED = "torch.optim.adam.adam"  # the function that `torch.optim.Adam` steps with
MAX_NUMBERS = 2**30  # of one parameter, which kernels count in 32 bits
# Options of torch's Adam that are left to torch, and all that a group of parameters has, but `betas`.
_TORCHS = ("amsgrad", "maximize", "weight_decay", "capturable", "differentiable", "has_complex")
_OPTIONS = (*_TORCHS[:-1], "lr", "eps", "foreach", "fused", "decoupled_weight_decay")

_module: Any = importlib.import_module("torch.optim.adam")  # torch.optim deletes its own name for it
_torchs_adam = _module.adam


class Adam(torch.optim.Adam):
    """`torch.optim.Adam` whose steps are those of `adam` below: options, state, state_dict and hooks are torch's."""

    # Torch wraps these two, and its wrapper loads the compiler: 75 MB and 800 modules that training has no use for.

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's."""
        inspect.unwrap(torch.optim.Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """As torch's."""
        if not set_to_none:
            inspect.unwrap(torch.optim.Optimizer.zero_grad)(self, set_to_none)
            return
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    def step(self, closure: Any = None) -> Any:  # type: ignore[override]
        """Update every parameter that has a gradient.

        Args:
            closure: Computes the loss anew, as torch's optimizers take it.

        Returns:
            What `closure` returns.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        with torch.set_grad_enabled(self.defaults["differentiable"]):
            for group in self.param_groups:
                self._step(group)
        return loss

    def _step(self, group: dict[str, Any]) -> None:
        lists: tuple[list[Tensor], ...] = ([], [], [], [], [], [])
        has_complex = self._init_group(group, *lists)
        adam(
            *lists,
            has_complex=has_complex,
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            grad_scale=getattr(self, "grad_scale", None),
            found_inf=getattr(self, "found_inf", None),
            **{name: group[name] for name in _OPTIONS if name in group},
        )


def moments(optimizer: torch.optim.Optimizer, param: Tensor) -> dict[str, Tensor]:
    """State of a parameter as `torch.optim.Adam` keeps it: `step`, `exp_avg`, `exp_avg_sq`; zeros the first time."""
    state: dict[str, Tensor] = optimizer.state[param]
    if not state:
        state["step"] = torch.tensor(0.0, dtype=torch.float32)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(param), torch.zeros_like(param)
    return state


def corrected(lr: float, step: Tensor, betas: tuple[float, float]) -> tuple[float, float]:
    """`rate` and `root` of `adam_step` in step number `step`, from 1 on: with the bias corrections of both means."""
    first, second = (1 - beta ** step.item() for beta in betas)
    return lr / first, second**0.5


def adam(
    params: Sequence[Tensor],
    grads: Sequence[Tensor],  # of the same shapes, as the next two
    exp_avgs: Sequence[Tensor],
    exp_avg_sqs: Sequence[Tensor],
    max_exp_avg_sqs: Sequence[Tensor],
    state_steps: Sequence[Tensor],
    *flags: Any,
    **options: Any,
) -> None:
    """As `torch.optim.adam.adam`: one step in place, on all cores, rounded as `adam_step` says.

    Whatever is not contiguous float32 on the CPU, and every option but `lr`, `betas` and `eps` (weight decay,
    amsgrad, maximize, capturable, differentiable, a scaler of gradients), is left to torch.

    Args:
        params: Updated, as the next but `grads`.
        grads: Their gradients.
        exp_avgs: Running means of the gradients.
        exp_avg_sqs: Running means of their squares.
        max_exp_avg_sqs: As torch has it.
        state_steps: Steps of each so far.
        flags: More of torch's, by position.
        options: More of torch's, by name.
    """
    everything = (params, grads, exp_avgs, exp_avg_sqs, max_exp_avg_sqs, state_steps)
    if flags or not _plain(options):
        _torchs_adam(*everything, *flags, **options)
        return
    lr, eps = float(options["lr"]), options["eps"]
    betas = options["beta1"], options["beta2"]
    left = []
    for number, tensors in enumerate(zip(params, grads, exp_avgs, exp_avg_sqs, strict=True)):
        step = state_steps[number]
        if step.device.type != "cpu" or not all(_fits(tensor, tensors[0]) for tensor in tensors):
            left.append(number)
            continue
        step += 1
        adam_step(None, *tensors, *corrected(lr, step, betas), betas, eps)
    if left:
        some = ([whole[i] for i in left] if whole else [] for whole in everything)
        _torchs_adam(*some, **options)


@contextmanager
def instead_of_torchs_adam() -> Iterator[None]:
    """Let every `torch.optim.Adam` step by `adam` inside the block, whenever it was made."""
    before = _module.adam
    _module.adam = adam
    try:
        yield
    finally:
        _module.adam = before


def _plain(options: dict[str, Any]) -> bool:
    """Whether the options are those that `adam` knows, and numbers."""
    if any(options.get(name) for name in _TORCHS):
        return False
    if options.get("grad_scale") is not None or options.get("found_inf") is not None:
        return False
    return not any(isinstance(options[name], Tensor) for name in ("beta1", "beta2"))


def _fits(tensor: Tensor, param: Tensor) -> bool:
    """Whether the kernel can read a tensor along with its parameter."""
    return (
        tensor.dtype is torch.float32
        and tensor.layout is torch.strided
        and tensor.is_cpu
        and tensor.is_contiguous()
        and tensor.shape == param.shape
        and tensor.numel() <= MAX_NUMBERS
    )
