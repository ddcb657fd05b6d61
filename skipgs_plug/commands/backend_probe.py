"""Renders four Gaussians with a backend in a process of its own, so that a native crash ends only that process."""

from __future__ import annotations

import signal
import subprocess
import sys
import warnings

LONGEST = 600  # seconds until a backend counts as hanging; compiling all kernels takes about a minute
# The child finds the package in the same place as this process, installed or not.
CODE = "import sys; sys.path[:] = {path!r}; from skipgs_plug.commands.backend_probe import main; main({name!r})"


def try_backend(name: str) -> tuple[bool, str]:
    """Return whether a backend renders and differentiates here, and a sentence about the result."""
    command = [sys.executable, "-c", CODE.format(path=sys.path, name=name)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {LONGEST // 60} minutes"
    lines = ended.stdout.splitlines()
    if ended.returncode in (0, 1) and lines:
        return ended.returncode == 0, lines[-1]
    said = ended.stderr.strip().splitlines()
    return False, f"the process that tried it {how_it_ended(ended.returncode)}{f': {said[-1]}' if said else ''}"


def how_it_ended(code: int) -> str:
    """Return a clause that tells how a process with this exit code ended."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    # Windows has codes above 255.
    return f"ended with exit code {code:#x}" if code > 255 else f"ended with exit code {code}"


def main(name: str) -> None:
    """Try a backend in this process. Print the result, and exit with 0 if it works, else with 1."""
    try:
        with warnings.catch_warnings(record=True) as cautions:
            warnings.simplefilter("always", RuntimeWarning)
            finding = render(name)
    except Exception as error:  # any error is a result
        print(str(error).splitlines()[0] if str(error) else type(error).__name__)
        raise SystemExit(1) from None
    print(finding, *(caution.message for caution in cautions), sep="; ")


def render(name: str) -> str:
    """Render four Gaussians at 16x16 with a backend, and differentiate.

    Raises:
        RuntimeError: Nothing was rendered.
    """
    import torch

    from skipgs_plug.trainer.backend import resolve_backend

    backend = resolve_backend(name)
    means = torch.tensor([[0.0, 0, 2], [0.2, 0, 2], [0, 0.2, 2], [-0.2, 0, 2]], device=backend.device)
    means.requires_grad_()
    image, _, _ = backend.rasterization(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]], device=backend.device).repeat(4, 1),
        scales=torch.full((4, 3), 0.1, device=backend.device),
        opacities=torch.full((4,), 0.8, device=backend.device),
        colors=torch.rand(4, 3, device=backend.device),
        viewmats=torch.eye(4, device=backend.device)[None],
        Ks=torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]], device=backend.device),
        width=16,
        height=16,
    )
    backend.loss(image[0], torch.zeros_like(image[0]), 0.2).backward()
    if not (float(image.detach().sum()) > 0 and means.grad is not None and bool(means.grad.any())):
        raise RuntimeError("it rendered nothing")
    return f"renders and differentiates on {backend.device}"
