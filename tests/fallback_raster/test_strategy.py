"""gsplat's DefaultStrategy works with the rasterizer's info as with gsplat's own."""

from __future__ import annotations

import pytest
import torch
from raster_scenes import random_scene

from skipgs_plug.fallback_raster import rasterization

DefaultStrategy = pytest.importorskip("gsplat.strategy").DefaultStrategy


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("absgrad", [False, True])
def test_default_strategy_densifies_and_prunes(packed: bool, absgrad: bool) -> None:
    torch.manual_seed(0)
    scene = random_scene(n=200, cameras=2, sh_degree=1)
    target = torch.rand(2, scene["height"], scene["width"], 3)
    opacities = scene["opacities"].clone()
    opacities[:20] = 0.001  # the strategy prunes these
    params = torch.nn.ParameterDict(
        {
            "means": torch.nn.Parameter(scene["means"]),
            "scales": torch.nn.Parameter(scene["scales"].log()),
            "quats": torch.nn.Parameter(scene["quats"]),
            "opacities": torch.nn.Parameter(opacities.logit()),
            "sh": torch.nn.Parameter(scene["colors"]),
        }
    )
    optimizers = {name: torch.optim.Adam([params[name]], lr=5e-3) for name in params}
    strategy = DefaultStrategy(
        refine_start_iter=2, refine_every=4, grow_grad2d=1e-6, absgrad=absgrad, refine_scale2d_stop_iter=100
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    losses = []
    for step in range(10):
        image, _, info = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=params["opacities"].sigmoid(),
            colors=params["sh"],
            viewmats=scene["viewmats"],
            Ks=scene["Ks"],
            width=scene["width"],
            height=scene["height"],
            sh_degree=1,
            packed=packed,
            absgrad=absgrad,
        )
        loss = (image - target).abs().mean()
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        losses.append(loss.item())
        if step == 3:
            assert state["count"].max() == 2 * 4
            assert state["grad2d"].isfinite().all() and state["grad2d"].any()
    assert len(params["means"]) > 200  # Gaussians were added
    assert (params["opacities"].sigmoid() >= strategy.prune_opa).all()  # and transparent ones pruned
    assert losses[4] < losses[0]  # densification after that may raise the loss briefly
