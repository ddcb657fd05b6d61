"""SOG, version 2: PlayCanvas's compressed format for the web, lossless WebP pictures in a ZIP file.

Written from the specification at developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. The axes are the
same as in a PLY.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.ply import sh_degree
from skipgs_plug.trainer.row_order import morton_order

VERSION = 2  # version of the format that is written
STEPS = (1 << 16) - 1  # steps from the lowest position to the highest: a coordinate has 16 bits
LEVELS = 256  # levels of a codebook: a number has one byte
ROUNDS = 8  # rounds of k-means; later ones change little
ROW = 64  # palette entries in one row of their picture, as the format says
LARGEST_COMPONENT = 252  # alpha of a rotation whose largest component is w; 253 to 255 stand for x, y and z
MOST_ENTRIES = 1 << 16  # palette entries, at most: a label has two bytes
GAUSSIANS_PER_ENTRY = 8  # Gaussians that share an entry on average, at least: more entries make the file larger
PAIRS = 5e8  # pairs of a Gaussian and an entry per round of the search, which takes seconds on one core
SAMPLES_PER_ENTRY = 16  # Gaussians per entry that the search looks at, at most; it bounds the time of a round
CHUNK = 4096  # Gaussians compared with all entries at once, which bounds memory


def to_sog(splats: Mapping[str, Tensor], antialiased: bool = False, pairs: float = PAIRS) -> bytes:
    """Return the file of a model with raw parameters like the result of `read_ply`, with neighbours in nearby rows.

    Positions are rounded to 2**-17 of the extent, on a scale that is finer near the origin (`position_error`).
    Opacities and rotations take one byte per number. Scales and constant colours have 256 levels that suit the model.
    The other harmonics are a palette of up to 65,536 entries.

    Args:
        splats: `means scales quats opacities sh0 shN`.
        antialiased: Whether the model was trained with antialiasing, which viewers must then use too.
        pairs: Pairs of a Gaussian and a palette entry that each round of the search may compare. Fewer are faster.
    """
    means = splats["means"].detach().cpu().double()
    order = morton_order(means)
    splats = {name: tensor.detach().cpu().float()[order] for name, tensor in splats.items()}
    n, bands = len(order), sh_degree(splats["shN"].shape[1])
    meta: dict[str, object] = {"version": VERSION, "asset": {"generator": "skipgs_plug"}, "count": n}
    if antialiased:
        meta["model"] = "antialiased"
    pictures: dict[str, np.ndarray] = {}

    quantized, lowest, highest = _positions(means[order].numpy())
    pictures["means_l"], pictures["means_u"] = _grid(quantized & 255), _grid(quantized >> 8)
    meta["means"] = {"mins": lowest, "maxs": highest, "files": ["means_l.webp", "means_u.webp"]}

    scales, codebook = _levels(splats["scales"].numpy())
    pictures["scales"] = _grid(scales)
    meta["scales"] = {"codebook": codebook, "files": ["scales.webp"]}

    pictures["quats"] = _grid(_rotations(splats["quats"].numpy()))
    meta["quats"] = {"files": ["quats.webp"]}

    colours, codebook = _levels(splats["sh0"][:, 0].numpy())
    opacities = np.rint(torch.sigmoid(splats["opacities"])[:, None].numpy() * 255)
    pictures["sh0"] = _grid(np.concatenate([colours, opacities], axis=1))
    meta["sh0"] = {"codebook": codebook, "files": ["sh0.webp"]}

    if bands:
        palette, labels = _palette(splats["shN"].flatten(1), pairs)
        entries, codebook = _levels(palette.reshape(-1, 3))
        rows = -(-len(palette) // ROW)
        padded = np.zeros((rows * ROW, palette.shape[1]), np.uint8)
        padded[: len(palette)] = entries.reshape(len(palette), -1)
        pictures["shN_centroids"] = padded.reshape(rows, -1, 3)
        pictures["shN_labels"] = _grid(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(palette), "bands": bands, "codebook": codebook, "files": files}

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, picture in pictures.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), _webp(picture))
    return stream.getvalue()


def position_error(means: Tensor) -> float:
    """Return the largest error by which positions [N, 3] are rounded."""
    _, lowest, highest = _positions(means.numpy())
    return max(
        (high - low) / STEPS / 2 * math.exp(max(abs(low), abs(high))) for low, high in zip(lowest, highest, strict=True)
    )


def _positions(means: np.ndarray) -> tuple[np.ndarray, list[float], list[float]]:
    """Return 16 bits per coordinate [N, 3], and the logarithmic positions that 0 and 65,535 stand for."""
    scaled = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    lowest, highest = scaled.min(axis=0), scaled.max(axis=0)
    extent = np.where(highest > lowest, highest - lowest, 1.0)
    quantized = np.rint((scaled - lowest) / extent * STEPS).astype(np.uint16)
    return quantized, lowest.tolist(), (lowest + extent).tolist()


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Return the three smaller components and the place of the largest one [N, 4]; signs make the largest positive."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(min=1e-12)
    largest = np.abs(quats).argmax(axis=1)[:, None]
    quats = quats * np.where(np.take_along_axis(quats, largest, axis=1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[:, 0]]
    smaller = np.take_along_axis(quats, others, axis=1) * 2**0.5  # each is at most the root of one half
    return np.concatenate([np.rint((smaller * 0.5 + 0.5) * 255), LARGEST_COMPONENT + largest], axis=1)


def _levels(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Return for each value [N, M] the number of its nearest level, and the 256 levels, found by k-means, ascending."""
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # Begin half-way between equal ranks and equal steps: tails are rare, but large Gaussians are visible.
    ranks, steps = (np.linspace(0, 1, LEVELS), np.linspace(ordered[0], ordered[-1], LEVELS))
    levels = np.sort((np.quantile(ordered, ranks) + steps) / 2)
    for _ in range(ROUNDS):
        edges = np.searchsorted(ordered, np.concatenate([[-np.inf], (levels[1:] + levels[:-1]) / 2, [np.inf]]))
        counts = np.diff(edges)
        levels = np.where(counts > 0, np.diff(sums[edges]) / counts.clip(min=1), levels)
        levels.sort()
    return np.searchsorted((levels[1:] + levels[:-1]) / 2, values).astype(np.uint8), levels.tolist()


def _palette(rows: Tensor, pairs: float) -> tuple[np.ndarray, np.ndarray]:
    """Return entries [K, C], found by k-means, and for each row [N, C] the number of its nearest entry."""
    n = len(rows)
    entries = int(max(1, min(MOST_ENTRIES, pairs // n, n // GAUSSIANS_PER_ENTRY)))
    generator = torch.Generator().manual_seed(0)
    sample = rows[torch.randperm(n, generator=generator)[: entries * SAMPLES_PER_ENTRY]]
    palette = sample[:entries].clone()
    for _ in range(ROUNDS if entries < n else 0):
        labels = _nearest(sample, palette)
        counts = torch.bincount(labels, minlength=entries)
        sums = torch.zeros_like(palette).index_add_(0, labels, sample)
        palette = torch.where(counts[:, None] > 0, sums / counts.clamp(min=1)[:, None], palette)
    return palette.numpy(), _nearest(rows, palette).numpy()


def _nearest(rows: Tensor, palette: Tensor) -> Tensor:
    half = (palette**2).sum(dim=1) / 2
    parts = [(half - part @ palette.T).argmin(dim=1) for part in rows.split(CHUNK)]
    return torch.cat(parts)


def _grid(rows: np.ndarray) -> np.ndarray:
    """Return a picture with one pixel per row [N, 3 or 4], from left to right, then down."""
    width = max(4, -(-int(np.ceil(len(rows) ** 0.5)) // 4) * 4)
    height = max(1, -(-len(rows) // width))
    picture = np.zeros((height * width, rows.shape[1]), np.uint8)
    picture[: len(rows)] = rows
    return picture.reshape(height, width, -1)


def _webp(picture: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    # exact: the colours of transparent pixels carry numbers too.
    Image.fromarray(picture).save(stream, format="WEBP", lossless=True, quality=60, method=4, exact=True)
    return stream.getvalue()
