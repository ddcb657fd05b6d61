"""Settings of the reference trainer, with the names of gsplat's simple_trainer."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, Optional

from skipgs_plug.trainer.errors import InputError

# Iterations of the 3DGS schedule. All milestone defaults are given for it.
REFERENCE_STEPS = 30_000
# Iterations between densifications, at least. A shorter interval averages gradients over too few views, and the number
# of Gaussians explodes: 4,000 points became 140,000 within 400 iterations at an interval of 3.
MIN_REFINE_EVERY = 100
# Iterations between opacity resets, at least. Gaussians need thousands of updates to recover from a reset, even in a
# short run: resets every 300 iterations cost 7 dB on fern.
MIN_RESET_EVERY = 3000

TINY = 1e-6  # smallest opacity, distance to 1, and scale: their logits and logarithms stay moderate
MANY = 1 << 31  # largest count, which fits the 32-bit indices of gsplat and of the kernels
INTEGERS = {  # least and greatest value of each setting
    "data_factor": (1, 64),
    "test_every": (0, MANY),
    "init_num_pts": (4, 1 << 27),
    "seed": (-(1 << 62), 1 << 62),
    "max_steps": (1, MANY),
    "schedule_steps": (1, MANY),
    "sh_degree": (0, 3),
    "sh_degree_interval": (1, MANY),
    "refine_start_iter": (0, MANY),
    "refine_stop_iter": (0, MANY),
    "refine_every": (1, MANY),
    "reset_every": (1, MANY),
    "cap_max": (4, MANY),
}
NUMBERS = {
    "ssim_lambda": (0.0, 1.0),
    "init_opa": (TINY, 1 - TINY),  # stored as a logit
    "init_scale": (TINY, 1e6),  # stored as a logarithm
    "means_lr": (0.0, 10.0),
    "scales_lr": (0.0, 10.0),
    "opacities_lr": (0.0, 10.0),
    "quats_lr": (0.0, 10.0),
    "sh0_lr": (0.0, 10.0),
    "shN_lr": (0.0, 10.0),
    "near_plane": (1e-30, 1e30),
    "far_plane": (1e-30, 1e30),
    "clear_depth": (0.0, 1.0),
    "grow_grad2d": (0.0, 1e6),
    "grow_scale3d": (0.0, 1e6),
    "prune_opa": (0.0, 1.0),
    "prune_scale3d": (0.0, 1e6),
    "noise_lr": (0.0, 1e12),
    "opacity_reg": (0.0, 1e6),
    "scale_reg": (0.0, 1e6),
}


class Recipe(NamedTuple):
    """Settings whose defaults depend on the strategy."""

    init_opa: float
    init_scale: float
    refine_stop_iter: int
    opacity_reg: float
    scale_reg: float


# The values of gsplat's script.
RECIPES = {"default": Recipe(0.1, 1.0, 15_000, 0.0, 0.0), "mcmc": Recipe(0.5, 0.1, 25_000, 0.01, 0.01)}
BELONGS_TO = {
    **dict.fromkeys(("grow_grad2d", "grow_scale3d", "prune_scale3d", "reset_every", "absgrad"), "default"),
    **dict.fromkeys(("cap_max", "noise_lr"), "mcmc"),
}
FROM_OTHERS = ("schedule_steps", "near_plane", *Recipe._fields)  # None: derived from other settings or the scene


@dataclass
class TrainConfig:
    """Settings of one training run. The defaults are the 3DGS recipe for 30,000 iterations.

    Milestones (`refine_*`, `reset_every`, `sh_degree_interval`) are given for 30,000 iterations. They are scaled
    together by `max_steps / 30_000`, so a short run keeps the shape of the full one. `refine_every` and `reset_every`
    stop shrinking at 100 and 3,000 iterations, because Gaussians adapt per update, not per share of the run.

    Raises:
        InputError: A value is out of its range, or belongs to the other strategy.

    Examples:
        >>> from skipgs_plug.trainer import TrainConfig
        >>> config = TrainConfig(data_dir="scenes/statue", result_dir="runs/statue", max_steps=3000)
        >>> config.scaled(15_000)  # densification ends after half of the run
        1500
        >>> TrainConfig(sh_degree=4)
        Traceback (most recent call last):
        ...
        skipgs_plug.trainer.errors.InputError: sh_degree=4 is not an integer in 0..3.
    """

    data_dir: str = ""
    """Scene: COLMAP, nerfstudio or Blender folder or packed .npz."""
    result_dir: str = ""
    """Run folder to write."""
    data_factor: int = 1
    """Use images_{factor}; without that folder, photographs are resized in memory."""
    test_every: int = 8
    """Hold out every n-th view by name (index % n == 0); 0 holds out no view."""
    init_num_pts: int = 100_000
    """Random initial points for scenes without a point cloud (Blender)."""
    init_ply: str = ""
    """Point cloud or 3DGS model (PLY, in the coordinates of the scene) to start from instead of the scene's points."""
    backend: Literal["auto", "gsplat", "warp"] = "auto"
    """Rasterizer: gsplat on CUDA, warp on the CPU; auto: gsplat if CUDA works, else warp."""
    seed: int = 42
    """Seed of view order, split noise and random backgrounds."""
    max_steps: int = 30_000
    """Training iterations."""
    schedule_steps: Optional[int] = None
    """Iterations that milestones and learning rates are scaled to; default: max_steps. An extended run
    keeps its first schedule, and goes on with the final rates of that schedule."""
    ssim_lambda: float = 0.2
    """Loss = (1 - ssim_lambda) * L1 + ssim_lambda * (1 - SSIM)."""

    sh_degree: int = 3
    """Highest spherical-harmonics degree."""
    sh_degree_interval: int = 1000
    """Iterations between two raises of the SH degree."""
    init_opa: Optional[float] = None
    """Initial opacity; default 0.1, with mcmc 0.5."""
    init_scale: Optional[float] = None
    """Initial scale, in units of the mean distance to the three nearest points; default 1, with mcmc 0.1."""

    means_lr: float = 1.6e-4
    """Learning rate of positions, times scene scale; decays to 1 % over max_steps."""
    scales_lr: float = 5e-3
    """Learning rate of log scales."""
    opacities_lr: float = 5e-2
    """Learning rate of opacity logits."""
    quats_lr: float = 1e-3
    """Learning rate of quaternions."""
    sh0_lr: float = 2.5e-3
    """Learning rate of the constant SH band."""
    shN_lr: float = 2.5e-3 / 20
    """Learning rate of the higher SH bands."""
    visible_adam: bool = False
    """Update only Gaussians that the view shows, without bias correction (gsplat's SelectiveAdam)."""

    exposure: bool = False
    """Learn an affine colour correction for each training photograph, for cameras that change their exposure."""
    antialiased: bool = False
    """Compensate opacities for the 2D low-pass filter (Mip-Splatting)."""
    random_bkgd: bool = False
    """Train on random background colours, so that no Gaussian imitates a background. Photographs must be opaque."""
    near_plane: Optional[float] = None
    """Near clipping plane, world units; default: a tenth of the depth of the nearest points that a view shows."""
    far_plane: float = 1e10
    """Far clipping plane, world units."""
    clear_depth: float = 0.5
    """Densification prunes Gaussians nearer to a camera than this share of the depth of the nearest points in its view:
    they are haze in captures of up to 100 views. 0 prunes none, as the plain recipe."""

    strategy: Literal["default", "mcmc"] = "default"
    """Densification: gsplat's DefaultStrategy (clone, split, prune) or MCMCStrategy (move, up to cap_max)."""
    refine_start_iter: int = 500
    """First densification."""
    refine_stop_iter: Optional[int] = None
    """End of densification; a gate becomes active here. Default 15,000, with mcmc 25,000."""
    refine_every: int = 100
    """Iterations between densifications."""
    reset_every: int = 3000
    """Iterations between opacity resets."""
    grow_grad2d: float = 0.0002
    """Mean screen-space gradient above which a Gaussian is duplicated or split."""
    grow_scale3d: float = 0.01
    """Gaussians larger than this, times scene scale, are split instead of duplicated."""
    prune_opa: float = 0.005
    """Gaussians below this opacity are pruned."""
    prune_scale3d: float = 0.1
    """Gaussians larger than this, times scene scale, are pruned after the first opacity reset."""
    absgrad: bool = False
    """Densify by absolute gradients (AbsGS); needs grow_grad2d of about 0.0008."""
    cap_max: int = 1_000_000
    """Largest number of Gaussians (mcmc)."""
    noise_lr: float = 5e5
    """Factor on the noise on positions, times their learning rate (mcmc)."""
    opacity_reg: Optional[float] = None
    """Weight of the mean opacity in the loss; default 0, with mcmc 0.01."""
    scale_reg: Optional[float] = None
    """Weight of the mean scale, in units of the scene scale, in the loss; default 0, with mcmc 0.01."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{field.name}={value} is not a finite number.")
        for name, (low, high) in INTEGERS.items():
            value = getattr(self, name)
            if value is None and name in FROM_OTHERS:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(f"{name}={value!r} is not an integer in {low}..{high:,}.")
        for name, (least, greatest) in NUMBERS.items():
            value = getattr(self, name)
            if value is None and name in FROM_OTHERS:
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= greatest:
                raise InputError(f"{name}={value!r} is outside {least:g}..{greatest:g}.")
        if self.strategy not in RECIPES:
            raise InputError(f"strategy={self.strategy!r} is unknown; choose {' or '.join(RECIPES)}.")
        for name, strategy in BELONGS_TO.items():
            if strategy != self.strategy and getattr(self, name) != type(self).__dataclass_fields__[name].default:
                raise InputError(
                    f"{name} belongs to strategy {strategy}, but strategy is {self.strategy}; leave it out."
                )
        if self.near_plane is not None and self.near_plane >= self.far_plane:
            raise InputError(f"near_plane={self.near_plane:g} is not below far_plane={self.far_plane:g}.")

    @property
    def recipe(self) -> Recipe:
        """Values in force of the settings whose defaults depend on the strategy."""
        given = {name: getattr(self, name) for name in Recipe._fields}
        return RECIPES[self.strategy]._replace(**{name: value for name, value in given.items() if value is not None})

    @property
    def schedule(self) -> int:
        """Iterations that milestones and learning rates are scaled to."""
        return self.schedule_steps or self.max_steps

    def scaled(self, milestone: int) -> int:
        """Return a milestone of the 30,000-iteration schedule in iterations of this run, at least 1."""
        return max(1, round(milestone * self.schedule / REFERENCE_STEPS))

    def scaled_interval(self, interval: int, least: int) -> int:
        """Scale an interval like `scaled`, but not below `least`, or not at all if it is smaller than `least`."""
        return max(self.scaled(interval), min(interval, least))
