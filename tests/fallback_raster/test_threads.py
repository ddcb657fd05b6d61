"""The number of threads changes the time, never the result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from raster_scenes import leaves, random_scene

from skipgs_plug.fallback_raster import rasterization, set_num_threads
from skipgs_plug.fallback_raster.runtime.threads import get_num_threads


@pytest.fixture
def threads() -> Iterator[Any]:
    previous = get_num_threads()
    yield set_num_threads
    set_num_threads(previous)


@pytest.mark.parametrize("sh_degree", [None, 3])
def test_results_are_bit_equal(threads: Any, sh_degree: int | None) -> None:
    scene = random_scene(n=3000, width=90, height=70, cameras=2, sh_degree=sh_degree, backgrounds=True)
    results = []
    for count in (1, 2, 3):
        threads(count)
        inputs = leaves(scene, torch.float32)
        image, alpha, info = rasterization(**inputs, absgrad=True, render_mode="RGB+ED", packed=False)
        info["means2d"].retain_grad()
        (image.square().sum() + alpha.sum()).backward()
        gradients = [t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None]
        assert len(gradients) == 6
        results.append([image, alpha, *gradients, info["means2d"].grad, info["means2d"].absgrad])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("count", [0, -1, 1.5])
def test_a_useless_number_of_threads_is_refused(count: Any) -> None:
    with pytest.raises(ValueError, match="thread"):
        set_num_threads(count)
