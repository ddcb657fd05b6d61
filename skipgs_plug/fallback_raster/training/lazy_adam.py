"""Adam for a parameter of many rows of which few are needed at a time: the others are caught up when they are."""

import math
from typing import Annotated, Any, NamedTuple

import torch
from numpy import float32
from torch import Tensor

from ..runtime.buffers import floats, zeros
from ..runtime.constants import BANDS
from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, IntArray, IntOutput
from .adam import Decay, Moments, decay
from .factored_gradient import FactoredGradient, Factors, plain
from .optimizer import Adam, moments, next_step

# Steps that a row may miss before all rows are caught up: their rates are kept, 12 bytes a step.
STEPS = 1024
# Steps of a row between two looks at how small its numbers have become.
STEPS_PER_CHECK = 32


class GradientFactors(NamedTuple):
    """A gradient as outer products, see `Factors`."""

    directions: Annotated[FloatArray, "m if with_gradient else 0, FACTOR"]
    colors: Annotated[FloatArray, "m if with_gradient else 0, FACTOR"]
    degree: int


class MissedSteps(NamedTuple):
    """What `adam_step` takes as `rate` and `root` in each of the steps."""

    rates: Annotated[FloatArray, "steps"]
    roots: Annotated[FloatArray, "steps"]
    inverse_roots: Annotated[FloatArray, "steps"]


class SafeRange(NamedTuple):
    """Between which sizes of a row's numbers nothing comes near underflow or overflow in STEPS_PER_CHECK steps."""

    grow: float  # 1 / sqrt(keep2)
    longest_rate: float  # of all steps; infinite where decay makes steps longer
    least_mean: float
    most_mean: float
    least_square: float


@worker(file="catch_up.h", items="m", grain=256, constants={"STEPS_PER_CHECK": STEPS_PER_CHECK})
def _catch_up(
    *,
    rows: Annotated[IntArray, "m"],  # none of them twice
    done: Annotated[IntOutput, "n"],  # steps that each row has
    factors: GradientFactors,
    parameter: Moments,
    missed: MissedSteps,
    decay: Decay,
    safe: SafeRange,
    m: int,
    n: int,
    width: int,
    now: int,  # steps that rows get before the one with a gradient
    with_gradient: int,
) -> None: ...


class _Missed:
    """The steps since all rows were up to date, and how many of them each row has."""

    def __init__(self, param: Tensor, betas: tuple[float, float], eps: float) -> None:
        self.param, self.betas, self.eps = param, betas, eps
        self.done = zeros(len(param), dtype=torch.int32)
        self.rates, self.roots, self.inverse_roots = floats(STEPS), floats(STEPS), floats(STEPS)
        self._arrays = [tensor.numpy() for tensor in (self.rates, self.roots, self.inverse_roots)]
        self.now = 0
        self._least, self._most = math.inf, 0.0

    def require(self, param: Tensor) -> None:
        """Raise RuntimeError unless these are the steps of this parameter."""
        if param is not self.param:
            raise RuntimeError("The parameter of a LazyAdam was replaced: call catch_up() before that.")

    def add(self, rate: float, root: float) -> None:
        """Note a step; it is complete when `now` is raised."""
        for array, value in zip(self._arrays, (rate, root, 1.0 / float32(root)), strict=True):
            array[self.now] = value
        self._least = min(self._least, abs(rate) or math.inf)
        self._most = max(self._most, abs(rate))

    def advance(self, rows: Tensor, gradient: Factors | None, state: dict[str, Tensor]) -> None:
        """Bring rows [n] to `now`, and on by the step that was noted last where there is a gradient of them."""
        directions, colors, degree = (floats(0), floats(0), 0) if gradient is None else gradient[1:]
        beta1, beta2 = self.betas
        smallest = self._least * beta1 ** (STEPS_PER_CHECK + 1)
        safe = SafeRange(
            grow=beta2**-0.5,
            longest_rate=self._most if beta1**2 <= beta2 else math.inf,
            least_mean=2.0**-100 / smallest if smallest else math.inf,
            most_mean=2.0**60 / self._most if self._most else math.inf,
            least_square=max(2.0**-74, (2.0**13 * self.eps) ** 2) / beta2 ** (STEPS_PER_CHECK + 1),
        )
        _catch_up(
            rows=rows,
            done=self.done,
            factors=GradientFactors(directions, colors, degree),
            parameter=Moments(self.param.detach(), state["exp_avg"], state["exp_avg_sq"]),
            missed=MissedSteps(self.rates, self.roots, self.inverse_roots),
            decay=decay(self.betas, self.eps),
            safe=safe,
            m=len(rows),
            n=len(self.done),
            width=self.param[0].numel(),
            now=self.now,
            with_gradient=int(gradient is not None),
        )
        # Past torch's count of changes, by which it knows what is out of date in a backward pass.
        torch.autograd.graph.increment_version(self.param)


class LazyAdam(Adam):
    """`Adam` for one parameter [N, K, 3], to the bit, that advances only those rows that are asked for.

    Rows that a `FactoredGradient` does not name miss the step: with a gradient of zero their moments decay and the
    parameter moves on. `catch_up` makes up for that, whenever it is called and for whatever rows, with the same result.
    Before a row of the parameter is used, or anything of the optimizer's `state`, it has to be called.

    Args:
        params: One float32 parameter on the CPU, or a group with one, of at most 16 bands.
        lr: Learning rate, which may change from step to step.
        betas: Decay of the two means; the second is not 0.
        eps: Added to the root, more than 0.

    Raises:
        ValueError: It is not one parameter of that kind, or `eps` is 0.
    """

    def __init__(
        self, params: Any, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps)
        self._missed: _Missed | None = None
        given = [param for group in self.param_groups for param in group["params"]]
        if len(given) != 1 or not _fits(given[0]):
            raise ValueError(
                f"LazyAdam takes one contiguous float32 parameter [N, K, 3] on the CPU with K of 1 to {BANDS}, got "
                f"{[(tuple(param.shape), param.dtype, param.device.type) for param in given]}; use Adam for others."
            )
        if not eps > 0:
            raise ValueError(f"LazyAdam needs eps > 0, got {eps}: rows without any gradient would become NaN.")

    @torch.no_grad()
    def catch_up(self, rows: Tensor | None = None) -> None:
        """Bring rows up to date.

        Args:
            rows: Their numbers [M], int32, none twice; all rows without.

        Raises:
            RuntimeError: The parameter was replaced while rows of it were behind.
        """
        missed, param = self._missed, self.param_groups[0]["params"][0]
        if missed is None:
            return
        missed.require(param)
        if rows is None:
            every = torch.arange(len(param), dtype=torch.int32, device="cpu")
            missed.advance(every, None, self.state[param])
            self._missed = None
        elif len(rows):
            missed.advance(rows, None, self.state[param])

    @torch.no_grad()
    def receive(self, gradient: Factors) -> None:
        """Add to the gradient of the parameter, which is a `FactoredGradient` unless it has one already."""
        (param,) = self.param_groups[0]["params"]
        more = FactoredGradient(param.shape, [gradient])
        param.grad = more if param.grad is None else plain(param.grad) + plain(more)

    def state_dict(self) -> dict[str, Any]:
        """As torch's, of rows that are all up to date."""
        self.catch_up()
        return super().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's."""
        self.catch_up()
        super().load_state_dict(state_dict)

    def __getstate__(self) -> dict[str, Any]:
        """What copies and pickles hold: rows that are all up to date."""
        self.catch_up()
        return super().__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._missed = None

    def _step(self, group: dict[str, Any]) -> None:
        (param,) = group["params"]
        if param.grad is None:
            return
        factors = param.grad.factors if isinstance(param.grad, FactoredGradient) else None
        if factors is None:
            param.grad = plain(param.grad)
            self.catch_up()
            super()._step(group)
            return
        missed, state = self._missed, moments(self, param)
        betas, eps = group["betas"], group["eps"]
        if missed is not None and (missed.now == STEPS or (missed.betas, missed.eps) != (betas, eps)):
            self.catch_up()
            missed = None
        if missed is None:
            missed = self._missed = _Missed(param, betas, eps)
        missed.require(param)
        missed.add(*next_step(state["step"], float(group["lr"]), betas))
        if len(factors.rows):
            missed.advance(factors.rows, factors, state)
        missed.now += 1


def _fits(param: Tensor) -> bool:
    return (
        param.dtype is torch.float32
        and param.is_cpu
        and param.is_contiguous()
        and param.dim() == 3
        and len(param) > 0
        and 1 <= param.shape[1] <= BANDS
        and param.shape[2] == 3
    )
