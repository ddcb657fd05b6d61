"""A training loop of your own, in plain PyTorch, with a gate. manual_loop.py is the same loop without it."""

import argparse
import math
import random

import torch

from skipgs_plug import SkipGate
from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization

WIDTH, HEIGHT, VIEWS = 64, 48, 12

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=600)
args = parser.parse_args()
torch.manual_seed(0)
random.seed(0)


def make_splats(count):
    """Gaussians around the origin, as parameters."""
    start = {
        "means": torch.randn(count, 3) * 0.5,
        "quats": torch.randn(count, 4),
        "scales": torch.full((count, 3), math.log(0.15)),
        "opacities": torch.zeros(count),
        "colors": torch.randn(count, 3),
    }
    return {name: torch.nn.Parameter(value) for name, value in start.items()}


def make_camera(index):
    """World-to-camera matrix of a camera on a circle, 4 units from the origin."""
    angle = 2 * math.pi * index / VIEWS
    viewmat = torch.eye(4)
    viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
    viewmat[0, 2], viewmat[2, 0] = math.sin(angle), -math.sin(angle)
    viewmat[2, 3] = 4.0
    return viewmat


def render(splats, camera):
    """Image of the splats  # [H, W, 3]"""
    focal = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    image, _, _ = rasterization(
        splats["means"],
        splats["quats"],
        torch.exp(splats["scales"]),
        torch.sigmoid(splats["opacities"]),
        torch.sigmoid(splats["colors"]),
        camera[None],
        focal[None],
        WIDTH,
        HEIGHT,
        packed=False,
    )
    return image[0]


cameras = {f"view_{i:02d}.png": make_camera(i) for i in range(VIEWS)}
truth = make_splats(200)
with torch.no_grad():
    images = {name: render(truth, camera) for name, camera in cameras.items()}

splats = make_splats(100)
optimizer = torch.optim.Adam(splats.values(), lr=0.01)
gate = SkipGate(start_iter=args.steps // 2, warmup=args.steps // 20)

for step in range(args.steps):
    name = random.choice(list(cameras))
    loss = l1_ssim_loss(render(splats, cameras[name]), images[name])
    if step % 100 == 0:
        print(f"step {step}, loss {loss.item():.4f}")
    if gate.backward(loss, view=name, step=step):
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

with torch.no_grad():
    error = torch.stack([(render(splats, cameras[name]) - images[name]).square().mean() for name in cameras]).mean()
print(f"{args.steps} steps, PSNR {-10 * math.log10(error):.2f}")
print(gate.summary())
