"""Memory that the graph of a skipped iteration would hold until the trainer lets go of its loss and image.

    python benchmarks/skipped_graph.py

A backward frees what its graph saved; a skipped one does not. Most trainers overwrite `loss` and `image` only when the
next forward pass is done, so for that long there would be two graphs; the gate frees the first at the skip
(`skipgs_plug.core.saved_graph`). Here no gate is attached. Rendered are random Gaussians at 504x378 with
SH degree 3, L1 + SSIM, on the CPU rasterizer. Writes `benchmarks/results/skipped_graph.json`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from common import PARAMETERS, RESULTS, frustum_scene, leaves, provenance, write_part
from torch import Tensor

from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization


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


def main() -> None:
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
    write_part(RESULTS / "skipped_graph.json", "cpu", rows, provenance())


if __name__ == "__main__":
    main()
