"""The graph of a skipped iteration: memory that it would hold, and the price of keeping it within reach.

    python benchmarks/skipped_graph.py [memory] [price]

A backward frees what its graph saved; a skipped one does not. Most trainers overwrite `loss` and `image` only when the
next forward pass is done, so for that long there would be two graphs; the gate frees the first at the skip
(`skipgs_plug.core.saved_graph`). For "memory" no gate is attached. For "price" every second iteration keeps its graph
within reach, and processor seconds of neighbours are compared, on one thread. Rendered are random Gaussians at 504x378
with SH degree 3, L1 + SSIM, on the CPU rasterizer. Writes `benchmarks/results/skipped_graph.json`.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from common import PARAMETERS, RESULTS, frustum_scene, leaves, provenance, threads, write_part
from torch import Tensor

from skipgs_plug.core.saved_graph import SavedGraph
from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
from skipgs_plug.trainer.loss import l1_ssim_loss as loss_of_torch

PAIRS = 60  # of neighbouring iterations, either first in turn


def nodes(output: Tensor) -> Iterator[Any]:
    """Every function of the graph behind a tensor."""
    waiting, seen = [output.grad_fn], set()
    while waiting:
        node = waiting.pop()
        if node is not None and node not in seen:
            seen.add(node)
            waiting += [parent for parent, _ in node.next_functions]
            yield node


def held_bytes(output: Tensor, own: Sequence[Tensor]) -> int:
    """Bytes that the graph keeps alive beyond the tensors in `own`."""
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


def iteration(n: int, own_loss: bool) -> tuple[Callable[[], Tensor], Callable[[Tensor], None]]:
    """Forward and backward with n Gaussians; activations and loss in plain torch, as trainers have them, or fused."""
    scene = frustum_scene(n, 504, 378, sh_degree=3)
    scene["scales"], scene["opacities"] = scene["scales"].log(), scene["opacities"].logit()
    scene["features_dc"], scene["features_rest"] = scene["colors"][:, :1].clone(), scene["colors"][:, 1:].clone()
    names = [*(name for name in PARAMETERS if name != "colors"), "features_dc", "features_rest"]
    inputs = leaves(scene, names)
    target = torch.rand(1, 378, 504, 3)

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
    """Number of tensors that autograd saves in a forward."""
    saved: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: saved.append(tensor) or tensor, lambda tensor: tensor):
        forward()
    return len(saved)


def price(n: int, own_loss: bool) -> dict[str, Any]:
    """Processor seconds that keeping a graph within reach adds to an iteration that runs, and those of a skip."""
    forward, backward = iteration(n, own_loss)
    graph = SavedGraph()

    def seconds(kept: bool) -> float:
        begin = time.process_time()
        if kept:
            graph.open()
        loss = forward()
        graph.close()
        backward(loss)
        return time.process_time() - begin

    for kept in (False, True) * 3:
        seconds(kept)
    pairs = []
    for i in range(PAIRS):
        first = seconds(bool(i % 2))
        second = seconds(not i % 2)
        pairs.append((second, first) if i % 2 else (first, second))
    freeing = []
    for _ in range(PAIRS // 2):
        graph.open()
        loss = forward()
        graph.close()
        begin = time.process_time()
        graph.free(loss)
        freeing.append(time.process_time() - begin)
    plain = statistics.median(one for one, _ in pairs)
    return {
        "gaussians": n,
        "loss": "fused" if own_loss else "plain torch",
        "saved_tensors": saved_tensors(forward),
        "iteration_ms": 1000 * plain,
        "price_ms": 1000 * statistics.median(kept - one for one, kept in pairs),
        "price_share": statistics.median(kept / one for one, kept in pairs) - 1.0,
        "freeing_ms": 1000 * statistics.median(freeing),
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
        for n in (1000, 10_000, 100_000):
            for own_loss in (True, False):
                rows.append(price(n, own_loss))
                print(
                    "{gaussians:9,} Gaussians, {loss} loss: {saved_tensors} saved tensors, {price_ms:.3f} of "
                    "{iteration_ms:.1f} ms ({price_share:.2%}), freeing {freeing_ms:.3f} ms".format(**rows[-1])
                )
    return rows


def main(parts: Sequence[str]) -> None:
    for part in parts or ("memory", "price"):
        rows = {"memory": measure_memory, "price": measure_prices}[part]()
        write_part(RESULTS / "skipped_graph.json", part, rows, provenance())


if __name__ == "__main__":
    main(sys.argv[1:])
