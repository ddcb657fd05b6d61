"""The graph of a skipped iteration: the memory that it would occupy, and the time to free it.

    python benchmarks/skipped_graph.py [memory] [price]

A backward pass frees the tensors that its graph saved; a skipped one does not. Most trainers overwrite `loss` and
`image` only after the next forward pass, so two graphs would exist until then. The gate frees the first graph when it
skips (`skipgs_plug.core.saved_graph`). "memory" runs without a gate. "price" compares processor seconds of an iteration
and of freeing a graph, on one thread. An iteration that is not skipped pays nothing. Both render random Gaussians of SH
degree 3 with an L1 + SSIM loss on the CPU rasterizer. Writes `benchmarks/results/skipped_graph.json`.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from common import PARAMETERS, RESULTS, frustum_scene, leaves, provenance, threads, write_part
from torch import Tensor

from skipgs_plug.core.saved_graph import free_graph, nodes
from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
from skipgs_plug.trainer.loss import l1_ssim_loss as loss_of_torch

PAIRS = 30  # repeats, each of an iteration and a skip


def held_bytes(output: Tensor, own: Sequence[Tensor]) -> int:
    """Return the bytes that the graph keeps alive, without the tensors in `own`."""
    storages = {}
    for node in nodes(output):
        saved = [getattr(node, name) for name in dir(node) if name.startswith("_saved_")]
        saved += getattr(node, "saved_tensors", ())
        if hasattr(node, "bins"):  # tile lists of the CPU rasterizer
            saved += [getattr(node.bins, field.name) for field in dataclasses.fields(node.bins)]
        for tensor in saved:
            if isinstance(tensor, Tensor):
                storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
    for tensor in own:
        storages.pop(tensor.untyped_storage().data_ptr(), None)
    return sum(storages.values())


def iteration(n: int, own_loss: bool, width: int, height: int) -> tuple[Callable[[], Tensor], Callable[[Tensor], None]]:
    """Return forward and backward functions for n Gaussians, with the loss in plain torch, as in trainers, or fused."""
    scene = frustum_scene(n, width, height, sh_degree=3)
    scene["scales"], scene["opacities"] = scene["scales"].log(), scene["opacities"].logit()
    scene["features_dc"], scene["features_rest"] = scene["colors"][:, :1].clone(), scene["colors"][:, 1:].clone()
    names = [*(name for name in PARAMETERS if name != "colors"), "features_dc", "features_rest"]
    inputs = leaves(scene, names)
    target = torch.rand(1, height, width, 3)

    def forward() -> Tensor:
        now = {name: value for name, value in inputs.items() if not name.startswith("features")}
        now["colors"] = torch.cat([inputs["features_dc"], inputs["features_rest"]], 1)
        now["scales"], now["opacities"] = inputs["scales"].exp(), inputs["opacities"].sigmoid()
        now["quats"] = torch.nn.functional.normalize(inputs["quats"])
        image, _, _ = rasterization(**now, packed=False)
        return l1_ssim_loss(image, target) if own_loss else loss_of_torch(image, target)

    def backward(loss: Tensor) -> None:
        loss.backward()
        for name in names:
            inputs[name].grad = None

    return forward, backward


def saved_tensors(forward: Callable[[], Tensor]) -> int:
    """Return the number of tensors that autograd saves in a forward pass."""
    saved: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: saved.append(tensor) or tensor, lambda tensor: tensor):
        forward()
    return len(saved)


def price(n: int, own_loss: bool, width: int, height: int) -> dict[str, Any]:
    """Measure processor seconds of an iteration, and of freeing the graph of a skipped one."""
    forward, backward = iteration(n, own_loss, width, height)
    runs, freeing = [], []
    for _ in range(PAIRS + 3):
        begin = time.process_time()
        backward(forward())
        runs.append(time.process_time() - begin)
        loss = forward()
        begin = time.process_time()
        free_graph(loss)
        freeing.append(time.process_time() - begin)
    ran, freed = statistics.median(runs[3:]), statistics.median(freeing[3:])
    return {
        "gaussians": n,
        "size": f"{width}x{height}",
        "loss": "fused" if own_loss else "plain torch",
        "saved_tensors": saved_tensors(forward),
        "iteration_ms": 1000 * ran,
        "freeing_ms": 1000 * freed,
        "freeing_share": freed / ran,
    }


def measure_memory() -> list[dict[str, Any]]:
    rows = []
    for n in (10_000, 100_000, 1_000_000):
        inputs = leaves(frustum_scene(n, 504, 378, sh_degree=3), PARAMETERS)
        target = torch.rand(1, 378, 504, 3)
        image, _, _ = rasterization(**inputs, packed=False)
        loss = l1_ssim_loss(image, target)
        own = [*(value for value in inputs.values() if isinstance(value, Tensor)), target]
        model = sum(inputs[name].numel() for name in PARAMETERS) * 4
        rows.append({"gaussians": n, "graph_mib": held_bytes(loss, own) / 2**20, "parameters_mib": model / 2**20})
        print(f"{n:9,} Gaussians: graph {rows[-1]['graph_mib']:6.1f} MiB, parameters {rows[-1]['parameters_mib']:6.1f}")
    return rows


def measure_prices() -> list[dict[str, Any]]:
    rows = []
    with threads(1):
        for n, width, height in ((300, 64, 48), (1000, 126, 94), (10_000, 504, 378), (100_000, 504, 378)):
            for own_loss in (True, False):
                rows.append(price(n, own_loss, width, height))
                print(
                    "{gaussians:9,} Gaussians at {size}, {loss} loss: {saved_tensors} saved tensors, "
                    "iteration {iteration_ms:.2f} ms, freeing {freeing_ms:.3f} ms ({freeing_share:.2%})".format(
                        **rows[-1]
                    )
                )
    return rows


def main(parts: Sequence[str]) -> None:
    for part in parts or ("memory", "price"):
        rows = {"memory": measure_memory, "price": measure_prices}[part]()
        write_part(RESULTS / "skipped_graph.json", part, rows, provenance())


if __name__ == "__main__":
    main(sys.argv[1:])
