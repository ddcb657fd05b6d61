"""Counts blended (pixel, Gaussian) pairs by definition, without the lists and bounds of the rasterizer."""

from typing import Any

import torch

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.launch import worker
from skipgs_plug.fallback_raster.runtime.parameters import FloatArray, FloatOutput


# Each tile goes through all Gaussians, nearest first. The box around the ellipse alpha = 1/255 only excludes Gaussians.
@worker(
    """
for (int t = first; t < last; ++t) {
    const int x0 = t % tiles_x * 16, y0 = t / tiles_x * 16;
    v16 T[16], count = (v16)0.0f;
    const v16 x = lane + (x0 + 0.5f);
    for (int y = 0; y < 16; ++y) T[y] = (x < (float)width) & (i16)(y0 + y < height ? -1 : 0) ? (v16)1.0f : (v16)-1.0f;
    int open = 16;
    for (int g = 0; g < n && open; ++g) {
        const float* r = rows + 8 * g;
        if (r[0] + r[6] < x0 || r[0] - r[6] > x0 + 16 || r[1] + r[7] < y0 || r[1] - r[7] > y0 + 16) continue;
        open = 0;
        for (int y = 0; y < 16; ++y) {
            const v16 dx = x - r[0];
            const float dy = y0 + y + 0.5f - r[1];
            const v16 sigma = 0.5f * (r[2] * dx * dx + r[4] * dy * dy) + r[3] * dx * dy;
            const v16 alpha = vmin((v16)0.999f, r[5] * exp2(vmax(sigma * -1.44269504f, (v16)-100.0f)));
            const i16 hit = (T[y] > 0.0f) & (sigma >= 0.0f) & (alpha >= 1.0f / 255.0f);
            const v16 next = T[y] * (1.0f - alpha);
            const i16 finished = hit & (next <= 1e-4f);
            count += hit & ~finished ? (v16)1.0f : (v16)0.0f;
            T[y] = finished ? (v16)-1.0f : (hit ? next : T[y]);
            open |= any(T[y] > 0.0f);
        }
    }
    counts[t] = sum(count);
}
""",
    items="tiles_x * ((height + 15) / 16)",
    grain=1,
)
def count_tiles(
    rows: FloatArray,  # [N, 8] 2D mean, conic, opacity, half width and half height of the box; nearest first
    counts: FloatOutput,  # output [tiles]
    n: int,
    width: int,
    height: int,
    tiles_x: int,
) -> None: ...


@torch.no_grad()
def blended_pairs(scene: dict[str, Any]) -> int:
    """Return the number of pairs with an alpha of at least 1/255 in pixels that are not finished."""
    *_, info = rasterization(**scene, packed=True)
    order = info["depths"].argsort(stable=True)
    means, conics, opacities = (info[name][order] for name in ("means2d", "conics", "opacities"))
    a, b, c = conics.double().unbind(-1)
    reach = (2 * torch.log(255 * opacities.double()).clamp(min=0))[:, None]
    box = (reach * torch.stack([c, a], 1) / (a * c - b * b)[:, None]).sqrt() + 1
    rows = torch.cat([means, conics, opacities[:, None], box.float()], 1)
    width, height = scene["width"], scene["height"]
    tiles_x, tiles_y = -(-width // 16), -(-height // 16)
    counts = torch.empty(tiles_x * tiles_y)
    count_tiles(rows, counts, len(rows), width, height, tiles_x)
    return int(counts.sum(dtype=torch.float64))
