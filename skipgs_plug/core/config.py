"""Settings of the gate, with defaults and their reasons."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from skipgs_plug.core.errors import SkipGSError

ON_NONFINITE = ("skip", "raise", "pass")


@dataclasses.dataclass(frozen=True)
class SkipConfig:
    """Settings of a gate. The first six fields have the names and defaults of the authors' controller.

    Args:
        start_iter: First iteration that may be skipped, usually the end of densification. It is counted as the
            trainer counts. None takes the value of the adapter.
        threshold: Skip when loss <= mean * (1 + threshold). A larger value skips more.
        ema_decay: Decay of each view's running mean of its loss, per visit.
        warmup: Iterations after `start_iter` without skips. They seed the means and set the floor.
        min_bwd_ratio: Least share of backward passes that run. "auto" is
            max(0.5, 1 - 0.5 * share that warm-up would have skipped); 0.0 removes the floor.
        enabled: False leaves training bit-identical to training without a gate.
        on_nonfinite: How to treat a NaN or infinite loss: "skip" its backward pass, "raise" an error, or "pass" it
            on. It never enters a mean. If as many in a row as there are views are not finite, the gate is released.
        pause_iters: Number of backward passes that run after a structural change. None is max(number of views, 500).
        share: Share of all iterations that runs, densification included, or "auto" for as many as the scene needs. It
            is the value of `grow_share` and `refine_share` where they are None.
        grow_share: Share of the iterations until densification ends that runs, or "auto". Densification events with
            too few iterations before them are left out.
        refine_share: Share of the iterations from `start_iter` on that runs, or "auto". None for the paper's gate,
            unless `share` is given.
        half_size: With `share` or `grow_share`: train on photographs of half the width and height until densification
            ends or the scene has e times as many Gaussians, at most in the first half of the run. None with "auto" is
            True if the trainer's adapter can do it and the photographs lose little by it; otherwise False.
        max_gaussians: With `share` or `grow_share`: densification stops before an event could exceed this number
            of Gaussians. None for no bound.
        always: With a share: iterations that always run besides those that the loop's conditions name. Conditions that
            cannot be evaluated in advance are no error then.
        tolerance: With "auto": refinement ends when the remaining iterations would gain less than this, in decibels.
        compensate: Take larger, shrinking steps to make up for iterations that are left out. None is True with a share
            and False with the paper's gate.
        rate_peak: Factor on learning rates when refinement begins. It falls linearly to 0. Higher SH bands, positions
            and scales take a multiple of it, the constant SH band takes half of it, and opacities at most 1. None is
            2 / max(refine_share, 0.25) * sqrt(3 * visible), where `visible` is the measured share of the Gaussians that
            a view shows, and up to 1.6 times as much where fewer than 1,500 iterations of refinement run.

    Raises:
        SkipGSError: A value is out of its range. The message names the field and the range.

    Examples:
        >>> from skipgs_plug import SkipConfig
        >>> config = SkipConfig(share="auto", max_gaussians=500_000)
        >>> config.leaves_out, config.compensates
        (True, True)
        >>> SkipConfig(threshold=-2)
        Traceback (most recent call last):
        ...
        skipgs_plug.core.errors.SkipGSError: threshold must be a number above -1, not -2.
    """

    start_iter: int | None = None
    threshold: float = 0.0
    ema_decay: float = 0.95
    warmup: int = 500
    min_bwd_ratio: float | str = "auto"
    enabled: bool = True
    on_nonfinite: str = "skip"
    pause_iters: int | None = None
    share: float | str | None = None
    grow_share: float | str | None = None
    refine_share: float | str | None = None
    half_size: bool | None = None
    max_gaussians: int | None = None
    always: tuple[int, ...] | None = None
    tolerance: float = 0.05
    compensate: bool | None = None
    rate_peak: float | None = None

    def __post_init__(self) -> None:
        if self.start_iter is not None:
            _check_count("start_iter", self.start_iter)
        _check_count("warmup", self.warmup)
        if self.pause_iters is not None:
            _check_count("pause_iters", self.pause_iters)
        if not (_is_number(self.threshold) and self.threshold > -1.0):
            raise SkipGSError(f"threshold must be a number above -1, not {self.threshold!r}.")
        if not (_is_number(self.ema_decay) and 0.0 <= self.ema_decay < 1.0):
            raise SkipGSError(f"ema_decay must be in [0, 1), not {self.ema_decay!r}.")
        ratio = self.min_bwd_ratio
        if ratio != "auto" and not (_is_number(ratio) and 0.0 <= float(ratio) <= 1.0):
            raise SkipGSError(f'min_bwd_ratio must be "auto" or in [0, 1], not {ratio!r}.')
        _check_choice("on_nonfinite", self.on_nonfinite, ON_NONFINITE)
        for name in ("share", "grow_share", "refine_share"):
            share = getattr(self, name)
            if share is not None and share != "auto" and not (_is_number(share) and 0.0 < float(share) <= 1.0):
                raise SkipGSError(f'{name} must be "auto" or in (0, 1], not {share!r}.')
        if self.max_gaussians is not None:
            _check_count("max_gaussians", self.max_gaussians, "Gaussians")
            if self.growing is None and self.enabled:
                raise SkipGSError("max_gaussians needs share or grow_share; give one of them too.")
        if self.half_size and self.growing is None and self.enabled:
            raise SkipGSError("half_size needs share or grow_share; give one of them too.")
        if self.always is not None:
            # Accept any collection of whole numbers and store a tuple. The class is frozen, hence object.__setattr__.
            object.__setattr__(self, "always", tuple(sorted(int(number) for number in self.always)))
            if self.always and self.always[0] < 0:
                raise SkipGSError(f"always must name iterations from 0 on, not {self.always[0]}.")
        if not (_is_number(self.tolerance) and self.tolerance >= 0.0):
            raise SkipGSError(f"tolerance must be a number of decibels >= 0, not {self.tolerance!r}.")
        if self.rate_peak is not None and not (_is_number(self.rate_peak) and self.rate_peak > 0.0):
            raise SkipGSError(f"rate_peak must be a factor above 0, not {self.rate_peak!r}.")
        if self.rate_peak is not None and self.compensate is False:
            raise SkipGSError("rate_peak is a factor of larger steps, which compensate=False turns off; leave one out.")

    @property
    def growing(self) -> float | str | None:
        """Share of the iterations before the end of densification that runs, or "auto"; None if all run."""
        return self.share if self.grow_share is None else self.grow_share

    @property
    def refining(self) -> float | str | None:
        """Share of the iterations after densification that runs, or "auto"; None for the paper's gate."""
        if self.refine_share is not None or self.growing is None:
            return self.refine_share
        return 1.0 if self.share is None else self.share

    @property
    def leaves_out(self) -> bool:
        """Whether whole iterations are left out."""
        return self.enabled and self.refining is not None

    @property
    def may_halve(self) -> bool:
        """Whether the scene may grow on photographs of half the size; see `half_size`."""
        if not self.enabled or self.growing is None:
            return False
        return self.growing == "auto" if self.half_size is None else self.half_size

    @property
    def compensates(self) -> bool:
        """Whether learning rates are scaled."""
        if not self.enabled:
            return False
        return self.refining is not None if self.compensate is None else self.compensate

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values, as skipgs.json holds them."""
        return dataclasses.asdict(self)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _check_count(name: str, value: Any, unit: str = "iterations") -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise SkipGSError(f"{name} must be a whole number of {unit} >= 0, not {value!r}.")


def _check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SkipGSError(f"{name} must be one of {', '.join(choices)}, not {value!r}.")


def shares_as_given(growing: float | str | None, refining: float | str | None) -> str:
    """Return the settings that ask for these shares of `SkipConfig.growing` and `SkipConfig.refining`, for messages."""
    if refining is None:
        return "no share"
    if growing is None:
        return f"refine_share={refining!r}"
    if growing == refining:
        return f"share={growing!r}"
    return f"grow_share={growing!r} and refine_share={refining!r}"


FIELDS = frozenset(field.name for field in dataclasses.fields(SkipConfig))


def settings_of(config: SkipConfig | None, fields: dict[str, Any]) -> SkipConfig:
    """Return the settings that are given as one object or as single fields.

    Args:
        config: All settings; None to take the fields.
        fields: Fields of `SkipConfig` by name.

    Raises:
        SkipGSError: A field does not exist or is out of range, or both arguments are given.
    """
    unknown = sorted(set(fields) - FIELDS)
    if unknown:
        raise SkipGSError(f"There is no setting {unknown[0]!r}; the settings are {', '.join(sorted(FIELDS))}.")
    if config is None:
        return SkipConfig(**fields)
    if fields:
        raise SkipGSError(f"Give either config= or {', '.join(fields)}, not both.")
    return config
