"""Adam for a parameter of many rows of which each step needs few: the others are caught up when they are needed."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from torch import Tensor

from .launch import FloatArray, IntArray, floats, ints, worker, zeros
from .optimizer import Adam
from .source import read_kernel

STEPS = 1024  # that a row may miss: the longest run of rates that is kept
WIDTH = 48  # floats of a row that the kernel holds in registers, at most
_CHUNK = 32  # steps between two looks at how small numbers have become


@worker(read_kernel("adam_rows.h"), items="n", grain="256", constants={"CHUNK": _CHUNK})
def _adam_rows(
    rows: Annotated[IntArray, "n"],
    done: Annotated[IntArray, "N"],  # steps that each row is advanced by, updated, as the next but `gradient`
    gradient: Annotated[FloatArray, "n * with_gradient, width"],
    values: Annotated[FloatArray, "N, width"],
    mean: Annotated[FloatArray, "N, width"],
    square: Annotated[FloatArray, "N, width"],
    rates: Annotated[FloatArray, "S"],  # of each step, as `adam_step` has it, as the next
    roots: Annotated[FloatArray, "S"],
    per_root: Annotated[FloatArray, "S"],  # 1 / roots
    n: int,
    width: int,
    now: int,  # steps to advance by, without the one that has a gradient
    with_gradient: int,
    all_rows: int,  # also those whose values have come to rest
    take1: float,
    keep2: float,
    take2: float,
    grow: float,  # 1 / sqrt(keep2)
    eps: float,
    least_mean: float,  # bounds of what arithmetic without division is exact for, and of the rates
    least_square: float,
    most_rate: float,
) -> None: ...


@dataclass
class _Missed:
    """Steps since all rows were up to date, and how many of them each row has."""

    group: dict[str, Any]  # betas, eps
    done: Tensor  # [N]
    most_rate: float  # beyond which rows at rest might move
    rates: Tensor = field(default_factory=lambda: floats(STEPS))
    roots: Tensor = field(default_factory=lambda: floats(STEPS))
    per_root: Tensor = field(default_factory=lambda: floats(STEPS))
    now: int = 0
    least_rate: float = math.inf


class LazyAdam(Adam):
    """`Adam` for one parameter [N, ...] with row-sparse gradients, equal to it to the bit, in time for the rows it gets."""

    def __init__(self, params: Any, **options: Any) -> None:
        super().__init__(params, **options)
        self._missed: _Missed | None = None

    @torch.no_grad()
    def catch_up(self, rows: Tensor | None = None) -> None:
        """Bring rows up to date: all without `rows`."""
        missed = self._missed
        if missed is None:
            return
        if rows is None:
            rows = torch.arange(len(missed.done), dtype=torch.int32)
            self._missed = None
        self._advance(missed, rows, floats(0), self._missed is None)

    def _param(self) -> Tensor:
        return self.param_groups[0]["params"][0]

    def _step(self, group: dict[str, Any]) -> None:
        param = self._param()
        grad = param.grad
        if grad is None:
            return
        if not grad.is_sparse:
            self.catch_up()
            super()._step(group)
            return
        rows = grad._indices()[0]
        if not bool((rows[1:] > rows[:-1]).all()):
            grad = grad.coalesce()
            rows = grad._indices()[0]
        state = self.state[param]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(param), torch.zeros_like(param)
        missed = self._missed
        kept = {name: group[name] for name in ("betas", "eps")}
        corrections = [1 - beta ** (state["step"].item() + 1) for beta in kept["betas"]]
        rate = float(group["lr"]) / corrections[0]
        if missed is not None and (missed.now == STEPS or missed.group != kept or rate > missed.most_rate):
            self.catch_up()
            missed = None
        if missed is None:
            missed = self._missed = _Missed(kept, zeros(len(param), dtype=torch.int32), 2 * rate)
        state["step"] += 1
        missed.rates[missed.now] = rate
        missed.roots[missed.now] = corrections[1] ** 0.5
        missed.per_root[missed.now] = 1 / missed.roots[missed.now]
        missed.least_rate = min(missed.least_rate, rate or math.inf)
        self._advance(missed, rows.to(torch.int32), grad._values(), True)
        missed.now += 1

    def _advance(self, missed: _Missed, rows: Tensor, gradient: Tensor, all_rows: bool) -> None:
        if not len(rows):
            return
        param = self._param()
        state = self.state[param]
        beta1, beta2 = missed.group["betas"]
        least_mean = 2.0**-100 / missed.least_rate / beta1 ** (_CHUNK + 1)
        least_square = 2.0**-74 / beta2 ** (_CHUNK + 1)
        width = param.numel() // len(param)
        _adam_rows(
            rows, missed.done, gradient, param.detach(), state["exp_avg"], state["exp_avg_sq"], missed.rates, missed.roots,
            missed.per_root, len(rows), width, missed.now, int(gradient.numel() > 0), int(all_rows), 1 - beta1, beta2, 1 - beta2,
            beta2**-0.5, missed.group["eps"], least_mean, least_square, missed.most_rate,
        )
        torch.autograd.graph.increment_version(param)
