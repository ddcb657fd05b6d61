"""Trains look-alikes on the simulated device and writes their host reads, iteration by iteration, as JSON.

    python lookalikes_on_sim.py [--mutant NAME] [--turn DAY | --turn all] [NAME ...]

It runs in a process of its own: autograd counts devices at the first backward pass, and other tests must not see `sim`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1] / "adapters"), str(Path(__file__).parents[2]), str(Path(__file__).parent)]

import torch  # noqa: E402
from simulated import SIM, OnSim, host, to_host, to_sim  # noqa: E402
from turns import chosen  # noqa: E402

FACTORIES = {
    *(torch.tensor, torch.zeros, torch.ones, torch.full, torch.empty, torch.eye),
    *(torch.rand, torch.randn, torch.arange, torch.linspace),
}
# Functions of the gate that call the trainer's own: reads inside them belong to the trainer.
PASSED_ON = {"around", "repeated", "method", "function", "hooked", "watched"}
SETTINGS: dict[str, dict[str, Any] | None] = {
    "off": {"enabled": False},
    "rule": {"warmup": 3, "min_bwd_ratio": 0.0, "pause_iters": 4},
    "floor": {"warmup": 3, "min_bwd_ratio": 0.5, "pause_iters": 4},
    "share": {"refine_share": 0.4, "pause_iters": 0},
}


class MadeOnSim(torch.overrides.TorchFunctionMode):
    """Put every tensor that a look-alike's own file makes on the device, like the trainer does."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor and str(kwargs.get("device", "")).startswith("sim"):
            return func(*args, **{**kwargs, "device": "cpu"}).to(SIM)  # CUDA makes it on the host too
        if func in FACTORIES and kwargs.get("device") is None and self._by_a_lookalike():
            return func(*args, **{**kwargs, "device": "cpu"}).to(SIM)
        return func(*args, **kwargs)

    @staticmethod
    def _by_a_lookalike() -> bool:
        frame = sys._getframe(2)
        while frame is not None and ("/torch/" in frame.f_code.co_filename or "contextlib" in frame.f_code.co_filename):
            frame = frame.f_back  # type: ignore[assignment]
        return frame is not None and "/lookalikes/" in frame.f_code.co_filename


def rasterization_on_sim(rasterization: Any) -> Any:
    """The CPU rasterizer as a CUDA extension that reads nothing back."""

    def on_sim(*args: Any, **kwargs: Any) -> Any:
        with host.paused():
            own = {name: to_host(value) for name, value in kwargs.items()}
            image, alpha, info = rasterization(*map(to_host, args), **own)
            image = to_sim(image)
            wants_grad = info["means2d"].requires_grad
            means2d = torch.zeros(info["means2d"].shape, device=SIM, requires_grad=wants_grad)
            if wants_grad:
                image = image + 0.0 * means2d.sum()
            there = {name: to_sim(value) for name, value in info.items()}
            return image, to_sim(alpha), {**there, "means2d": means2d}

    return on_sim


def host_reads(case: Any, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Train a look-alike with a gate; one row per iteration: `reason skip gate trainer`.

    `gate` and `trainer` list reads of the device: [kind, file, line, number of reads].
    """
    from lookalikes.splats import Log, new_log

    from skipgs_plug import SkipGate
    from skipgs_plug.core import decision
    from skipgs_plug.core.engine import Engine

    rows: list[dict[str, Any]] = []
    number: list[int | None] = [None]
    last: list[Any] = [None]  # latest decision in the present iteration

    def flush() -> None:
        taken = host.take()
        if number[0] is None:
            return
        answer, last[0] = last[0] or decision.INACTIVE, None
        row: dict[str, Any] = {"step": number[0], "reason": answer.reason, "skip": answer.skip}
        row |= {"gate": [], "trainer": []}
        for (kind, file, line, function), count in taken.items():
            # `Original` calls the trainer's own.
            passed_on = function in PASSED_ON or file.endswith("core/intercept.py")
            own = "/skipgs_plug/" in file and not passed_on
            row["gate" if own else "trainer"].append([kind, file.rsplit("/skipgs_plug/", 1)[-1], line, count])
        rows.append(row)

    begins = Log.begins

    def begin(self: Any, iteration: int, parameters: Any) -> None:
        flush()
        number[0] = iteration
        with host.paused():
            begins(self, iteration, parameters)

    decide = Engine.decide

    def noted(*args: Any, **kwargs: Any) -> Any:
        last[0] = decide(*args, **kwargs)
        return last[0]

    Log.begins, Engine.decide = begin, noted  # type: ignore[method-assign]
    try:
        with OnSim(), MadeOnSim():
            new_log()
            trainer, train = case.make()
            with SkipGate(trainer, **settings) as gate:
                train()
                flush()
            # Training goes on when the gate's own code fails. Here, that failure fails the test.
            if gate.released is not None:
                raise RuntimeError(gate.released)
    finally:
        Log.begins, Engine.decide = begins, decide  # type: ignore[method-assign]
    return rows


@contextlib.contextmanager
def mutant(name: str | None) -> Iterator[None]:
    """Put one defect into the gate that only a second device can show."""
    from skipgs_plug.core.engine import Engine

    if name is None:
        yield
        return
    decide = Engine.decide

    def reads_twice(self: Any, view: str, signal: Any) -> Any:
        float(signal.detach())
        return decide(self, view, signal)

    def meets_the_host(self: Any, view: str, signal: Any) -> Any:
        return decide(self, view, signal.detach() + torch.zeros(1))

    def through_numpy(self: Any, view: str, signal: Any) -> Any:
        return decide(self, view, float(signal.detach().numpy()))

    def masks(self: Any, view: str, signal: Any) -> Any:
        kept = signal.detach().reshape(1)
        return decide(self, view, kept[torch.ones(1, dtype=torch.bool, device=kept.device)].reshape(()))

    def multiplies_gradients(optimizer: Any, args: Any, kwargs: Any) -> None:
        for group in optimizer.param_groups:
            for param in group["params"]:
                if param.grad is not None:
                    param.grad.mul_(torch.ones(param.shape))

    handle = None
    mutants = {
        "loss read twice": reads_twice,
        "loss meets a tensor of the host": meets_the_host,
        "loss through numpy": through_numpy,
        "boolean mask": masks,
    }
    if name == "buffer of the host in a step hook":
        handle = torch.optim.optimizer.register_optimizer_step_pre_hook(multiplies_gradients)
    else:
        function = mutants[name]
        # Counts name the reader's file, so the defect gets the file of the gate.
        function.__code__ = function.__code__.replace(co_filename=decide.__code__.co_filename)
        Engine.decide = function  # type: ignore[method-assign]
    try:
        yield
    finally:
        Engine.decide = decide  # type: ignore[method-assign]
        if handle is not None:
            handle.remove()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--mutant", action="append", default=[])
    parser.add_argument("--settings", nargs="*", default=list(SETTINGS))
    parser.add_argument("--turn", help="a number of days, or all: instead of names")
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    from cases import CASES
    from lookalikes import splats

    names = chosen([case.name for case in CASES], asked.turn) if asked.turn else asked.names
    splats.rasterization = rasterization_on_sim(splats.rasterization)
    found: dict[str, Any] = {}
    for name in asked.mutant or [None]:
        for case in CASES:
            if case.name not in names:
                continue
            for label in asked.settings:
                try:
                    with mutant(name):
                        result: Any = host_reads(case, SETTINGS[label] or {})
                except Exception as error:
                    result = f"{type(error).__name__}: {error}"
                found.setdefault(name or "", {}).setdefault(case.name, {})[label] = result
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
