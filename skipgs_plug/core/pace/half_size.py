"""Until when a scene grows on photographs of half the size."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.half_size import Kept, kept_at_half_size
from skipgs_plug.core.pace.phase import PhasePlan


def require_half_size(config: SkipConfig, photographs: Callable[[], Iterable[Tensor]] | None) -> None:
    """Raise SkipGSError if the user asked for photographs of half the size, and they are not possible.

    Args:
        config: Settings with `half_size`.
        photographs: Returns some of them; None if views cannot be shown at half their size; see `TrainerInfo`.
    """
    if config.half_size and config.may_halve and photographs is None:
        raise SkipGSError(
            "half_size is not possible here: the adapter of this trainer does not show its views at half their size, "
            "or they are too small; leave it out."
        )


class HalfSize:
    """Decides until which iteration photographs have half the width and height.

    Args:
        config: Settings with `half_size`.

    Attributes:
        until: The iteration; 0 if they never have; None before `begin`.
        kept: What photographs keep at that size; None if it did not decide.
    """

    def __init__(self, config: SkipConfig) -> None:
        self._config = config
        self.until: int | None = None
        self.kept: Kept | None = None

    def begin(self, plan: PhasePlan) -> None:
        """Decide, unless a saved state did. All processes must call it together."""
        if self.until is None:
            self.until = min(plan.numbers.stop, (plan.last + 1) // 2) if self._pays(plan) else 0

    def _pays(self, plan: PhasePlan) -> bool:
        if plan.photographs is None or not self._config.may_halve:
            return False
        if self._config.half_size:
            return True
        self.kept = kept_at_half_size(plan.photographs)
        return self.kept.enough

    def holds(self, number: int) -> bool:
        """Return whether iteration `number` trains on a photograph of half the size."""
        return number < (self.until or 0)

    def end(self, number: int) -> None:
        """Give photographs their own size from iteration `number` on."""
        self.until = min(self.until or 0, number)

    def report(self) -> dict[str, Any]:
        """Return the entries of skipgs.json about such photographs.

        `half_size_until` (iteration before which photographs had half their size; 0 for none), `half_size_psnr`
        (decibels) and `half_size_ssim` (what they keep at that size; None for a measure that did not decide).
        """
        psnr, ssim = self.kept or (None, None)
        return {"half_size_until": self.until, "half_size_psnr": psnr, "half_size_ssim": ssim}

    def state_dict(self) -> list[Any]:
        return [self.until, None if self.kept is None else list(self.kept)]

    def load_state_dict(self, state: list[Any]) -> None:
        self.until, kept = state
        self.kept = Kept(*kept) if isinstance(kept, list) else None  # older states have the PSNR alone
