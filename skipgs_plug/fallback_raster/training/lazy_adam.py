"""Adam for a parameter with many rows of which few are needed at a time. Other rows are caught up when needed."""

import math
from typing import Annotated, Any, NamedTuple

import torch
from numpy import float32
from torch import Tensor

from ..runtime.buffers import floats, zeros
from ..runtime.constants import HIGHER_COEFFICIENTS
from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, IntArray, IntOutput
from .adam import Decay, Moments, decay
from .factored_gradient import FactoredGradient, Factors, plain
from .optimizer import Adam, moments, next_step

# Steps that a row may miss before all rows are caught up. It bounds the memory, three floats for each step or 12 KiB in
# all, and the time of the longest catch-up.
MAX_MISSED_STEPS = 1024
# Missed steps that are applied between two checks that the numbers of a row are in the safe range. More steps would
# narrow that range: in 33 steps the mean shrinks to 0.9^33 = 0.03 of its size.
STEPS_PER_CHECK = 32


class GradientFactors(NamedTuple):
    """A gradient as factors of outer products. See `Factors`."""

    directions: Annotated[FloatArray, "m if given else 0, FACTOR_FLOATS"]
    colors: Annotated[FloatArray, "m if given else 0, FACTOR_FLOATS"]
    degree: int
    given: int  # 1 if there is a gradient, 0 if only missed steps are applied


class MissedSteps(NamedTuple):
    """The arguments `rate` and `root` of `adam_step` for missed steps, and for a step with a gradient after them."""

    rates: Annotated[FloatArray, "steps"]
    roots: Annotated[FloatArray, "steps"]
    inverse_roots: Annotated[FloatArray, "steps"]
    number: int  # number of missed steps


class SafeRange(NamedTuple):
    """Bounds of a row's numbers within which STEPS_PER_CHECK steps come near neither underflow nor overflow."""

    grow: float  # 1 / sqrt(beta2)
    longest_rate: float  # largest rate of all steps; infinite if steps can grow although the mean decays
    least_mean: float
    most_mean: float
    least_square: float


@worker(file="catch_up.h", items="m", grain=256, constants={"STEPS_PER_CHECK": STEPS_PER_CHECK})
def _catch_up(
    *,
    rows: Annotated[IntArray, "m"],  # no row twice
    done: Annotated[IntOutput, "n"],  # number of steps that each row received
    factors: GradientFactors,
    parameter: Moments,
    missed: MissedSteps,
    decay: Decay,
    safe: SafeRange,
    m: int,
    n: int,
    width: int,
) -> None: ...


class _Missed:
    """The steps since all rows were up to date, and how many of them each row received."""

    def __init__(self, param: Tensor, betas: tuple[float, float], eps: float) -> None:
        self.param, self.betas, self.eps = param, betas, eps
        self.done = zeros(len(param), dtype=torch.int32)
        self.rates, self.roots, self.inverse_roots = (floats(MAX_MISSED_STEPS) for _ in range(3))
        self._arrays = [tensor.numpy() for tensor in (self.rates, self.roots, self.inverse_roots)]
        self.now = 0
        self._least, self._most = math.inf, 0.0

    def require(self, param: Tensor) -> None:
        """Raise RuntimeError if the parameter was replaced."""
        if param is not self.param:
            raise RuntimeError("The parameter of a LazyAdam was replaced: call catch_up() before that.")

    def add(self, rate: float, root: float) -> None:
        """Record a step. It counts once `now` is increased."""
        for array, value in zip(self._arrays, (rate, root, 1.0 / float32(root)), strict=True):
            array[self.now] = value
        self._least = min(self._least, abs(rate) or math.inf)
        self._most = max(self._most, abs(rate))

    def advance(self, rows: Tensor, gradient: Factors | None, state: dict[str, Tensor]) -> None:
        """Apply the steps up to `now` to rows [n], and the step recorded last if `gradient` is given."""
        if gradient is None:
            factors = GradientFactors(floats(0), floats(0), degree=0, given=0)
        else:
            factors = GradientFactors(gradient.directions, gradient.colors, gradient.degree, given=1)
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
            factors=factors,
            parameter=Moments(self.param.detach(), state["exp_avg"], state["exp_avg_sq"]),
            missed=MissedSteps(self.rates, self.roots, self.inverse_roots, self.now),
            decay=decay(self.betas, self.eps),
            safe=safe,
            m=len(rows),
            n=len(self.done),
            width=self.param[0].numel(),
        )
        # Kernels bypass torch's version counter, with which it detects outdated tensors in a backward pass.
        torch.autograd.graph.increment_version(self.param)


class LazyAdam(Adam):
    """`Adam` for one parameter [N, K, 3] that updates a row only when it is needed, with the same result to the bit.

    A row that the `FactoredGradient` of a step does not list has a gradient of zero. In `Adam` its moments would decay
    and its values would move. Here the row misses the step. `catch_up` applies missed steps later; when it is called,
    and for which rows, does not change the result. It must be called before rows of the parameter, or the optimizer's
    `state`, are read.

    Args:
        params: One contiguous float32 parameter [N, K, 3] on the CPU with K of 1 to 15, or a group with one.
        lr: Learning rate. It may change from step to step.
        betas: Decays of the two moments. The second must not be 0.
        eps: Added to the square root of the second moment, more than 0.

    Raises:
        ValueError: `params` is not one such parameter, or `eps` is not more than 0.
    """

    def __init__(
        self, params: Any, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps)
        self._missed: _Missed | None = None
        given = [param for group in self.param_groups for param in group["params"]]
        if len(given) != 1 or not _fits(given[0]):
            found = [(tuple(param.shape), param.dtype, param.device.type) for param in given]
            raise ValueError(
                "LazyAdam takes one contiguous float32 parameter [N, K, 3] on the CPU with K of 1 to "
                f"{HIGHER_COEFFICIENTS}, got {found}; use Adam for others."
            )
        if not eps > 0:
            raise ValueError(f"LazyAdam needs eps > 0, got {eps}: rows without any gradient would become NaN.")

    @torch.no_grad()
    def catch_up(self, rows: Tensor | None = None) -> None:
        """Apply the missed steps to rows.

        Args:
            rows: Row numbers [M], int32, no row twice. None stands for all rows.

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
        """Add a gradient to that of the parameter. It stays in factors if the parameter had none before."""
        (param,) = self.param_groups[0]["params"]
        more = FactoredGradient(param.shape, [gradient])
        param.grad = more if param.grad is None else plain(param.grad) + plain(more)

    def state_dict(self) -> dict[str, Any]:
        """Return torch's state dictionary, with all rows up to date."""
        self.catch_up()
        return super().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state dictionary of torch's Adam, after applying missed steps."""
        self.catch_up()
        super().load_state_dict(state_dict)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and pickles, with all rows up to date."""
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
        if missed is not None and (missed.now == MAX_MISSED_STEPS or (missed.betas, missed.eps) != (betas, eps)):
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
        and 1 <= param.shape[1] <= HIGHER_COEFFICIENTS
        and param.shape[2] == 3
    )
