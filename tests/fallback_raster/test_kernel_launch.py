"""Kernel calls cannot go wrong silently: every argument of every kernel is checked before anything is launched."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from compat_scenes import camera, gaussians
from raster_scenes import deep_scene, leaves, random_scene

from skipgs_plug.compat import statistics
from skipgs_plug.compat.compose import render, splats
from skipgs_plug.compat.inria import GaussianRasterizationSettings
from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
from skipgs_plug.fallback_raster.runtime import guard
from skipgs_plug.fallback_raster.runtime.launch import ByteArray, FloatArray, IntArray, LongArray, Worker, worker
from skipgs_plug.fallback_raster.runtime.source import KERNELS, PRELUDE, read_kernel
from skipgs_plug.fallback_raster.splats import rasterize_splats
from skipgs_plug.fallback_raster.stages import binning, blend, project, rows, sh, splat_backward, two_pass
from skipgs_plug.fallback_raster.training import adam, gradient_norms, lazy_adam, loss
from skipgs_plug.fallback_raster.training.factored_gradient import FactoredGradient, Factors

WORKERS = {
    found._name: found
    for module in (
        *(adam, binning, blend, gradient_norms, lazy_adam, loss, two_pass),
        *(project, rows, sh, splat_backward, statistics),
    )
    for value in vars(module).values()
    for found in (value.values() if isinstance(value, dict) else [value])
    if isinstance(found, Worker)
}
DTYPES = {FloatArray: torch.float32, IntArray: torch.int32, LongArray: torch.int64, ByteArray: torch.uint8}
EXAMPLES: dict[type, Any] = {kind: torch.zeros(0, dtype=dtype) for kind, dtype in DTYPES.items()} | {int: 0, float: 0.0}


def test_every_kernel_file_is_used_and_tested() -> None:
    texts = [PRELUDE, read_kernel("pool_serve.h"), read_kernel("pool_run.h")]
    texts += [found._code for found in WORKERS.values()]
    files = [path.relative_to(KERNELS).as_posix() for path in KERNELS.rglob("*.h")]
    unused = [file for file in files if not any(f'kernels/{file}"' in text for text in texts)]
    assert not unused
    assert len(WORKERS) == 32


@worker("out[0] = small; out[1] = large; numbers[0] = 2 * number; numbers[1] = most;", items="1", grain="1")
def _echo(out: FloatArray, numbers: IntArray, small: float, number: int, large: float, most: int) -> None: ...


@pytest.mark.parametrize("large", [1e39, -1e39, float("inf"), 3e38, 1e-50])
def test_numbers_arrive_as_they_are_and_beyond_float32_as_infinity(large: float) -> None:
    out, numbers = torch.zeros(2), torch.zeros(2, dtype=torch.int32)
    _echo(out, numbers, 0.1, -7, large, 2**31 - 1)
    assert torch.equal(out, torch.tensor([0.1, large], dtype=torch.float64).to(torch.float32))
    assert numbers.tolist() == [-14, 2**31 - 1]


@pytest.mark.parametrize("name", WORKERS)
def test_misuse_is_an_error_that_names_kernel_and_argument(name: str) -> None:
    found = WORKERS[name]
    valid = [EXAMPLES[kind] for kind in found._kinds.values()]
    for wrong in (valid[:-1], [*valid, 0], []):
        with pytest.raises(TypeError, match=f"{name} takes {len(valid)} arguments, got {len(wrong)}"):
            found(*wrong)
    for place, (parameter, kind) in enumerate(found._kinds.items()):
        wrong_values: list[Any] = [None, "1", [1.0]]
        if kind in DTYPES:
            square = torch.zeros(3, 3, dtype=DTYPES[kind])
            wrong_values += [1, 0.0, square.t(), square.to("meta"), square.numpy()]
            wrong_values += [square.to(dtype) for dtype in (torch.float64, torch.int16, torch.bool)]
            wrong_values += [square.to(dtype) for dtype in DTYPES.values() if dtype is not DTYPES[kind]]
        else:
            wrong_values += [square_one(kind), True, 1.0 if kind is int else 1]
        for value in wrong_values:
            with pytest.raises(TypeError, match=f"{name}: {parameter} must be a "):
                found(*valid[:place], value, *valid[place + 1 :])


def square_one(kind: type) -> torch.Tensor:
    return torch.ones((), dtype=torch.int32 if kind is int else torch.float32)


def test_a_number_beyond_32_bits_is_refused() -> None:
    with pytest.raises(OverflowError, match="list_visible: blocks = 2147483648"):
        project.list_visible(*[EXAMPLES[kind] for kind in project.list_visible._kinds.values()][:-1], 2**31)


def recorded_calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Worker, list[Any]]]:
    calls: dict[str, tuple[Worker, list[Any]]] = {}
    original = Worker.__call__

    def record(self: Worker, *arguments: Any) -> None:
        calls[self._name] = self, list(arguments)
        original(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Worker, "__call__", record)
        for channels, absgrad in ((1, True), (3, False), (4, True), (5, False), (3, True), (4, False), (1, False)):
            scene = leaves(random_scene(n=40, channels=channels), torch.float32, extra=("viewmats",))
            image, _, _ = rasterization(**scene, absgrad=absgrad, rasterize_mode="antialiased")
            image.sum().backward()
        scene = leaves(random_scene(n=40, sh_degree=2), torch.float32)
        image, _, _ = rasterization(**scene, render_mode="RGB+D")
        deep = deep_scene(6000, size=4.0)
        rasterization(**deep)
        raw = [deep[name] for name in ("means", "quats", "scales", "opacities")]
        sh = [deep["colors"][:, None], torch.zeros(6000, 0, 3)]
        seen = deep["viewmats"][0], deep["Ks"][0], deep["width"], deep["height"], 0
        for own in (raw, [t.clone().requires_grad_() for t in raw]):
            splats_image, _, _ = rasterize_splats(*own, *sh, *seen, absgrad=True)
        splats_image.sum().backward()
        for dtype in (torch.float32, torch.uint8):
            l1_ssim_loss(image, torch.zeros_like(image, dtype=dtype)).backward(retain_graph=True)
        param = torch.nn.Parameter(torch.ones(5, 3))
        param.grad = torch.ones(5, 3)
        adam.adam_rows(torch.ones(5) > 0, param, torch.zeros(5, 3), torch.zeros(5, 3), 0.1, (0.9, 0.999), 1e-15)
        bands = torch.nn.Parameter(torch.ones(5, 15, 3))
        factors = Factors(torch.tensor([1, 3], dtype=torch.int32), torch.ones(2, 4), torch.ones(2, 4), 3)
        bands.grad = FactoredGradient(bands.shape, [factors])
        bands.grad.dense()
        lazy_adam.LazyAdam([bands]).step()
        sums = torch.zeros(5), torch.zeros(5)
        gradient_norms.sum_norms(torch.tensor([1, 3], dtype=torch.int32), torch.ones(2, 2), (1.0, 1.0), *sums)
        with torch.no_grad():
            statistics.gather(render(GaussianRasterizationSettings(**camera()), splats(**gaussians())).footprint)
    return list(calls.values())


def test_a_tensor_of_another_size_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = recorded_calls(monkeypatch)
    assert {found._name for found, _ in calls} == set(WORKERS)
    # Sizes that nothing else in a call tells, or only up to a whole vector.
    free = {("project_backward", "visible"), ("sh_forward", "visible"), ("sh_backward", "visible")}
    free |= {("reduce_pairs", "pair_slot"), ("splat_backward", "pair_slot")}
    for found, arguments in calls:
        for place, (parameter, kind) in enumerate(found._kinds.items()):
            if kind not in DTYPES or not arguments[place].numel() or (found._name, parameter) in free:
                continue
            flat = arguments[place].detach().flatten()
            for wrong in (flat[:-1], torch.cat([flat, flat[:1]])):
                with pytest.raises(ValueError, match=f"^{found._name}: "):
                    found(*arguments[:place], wrong, *arguments[place + 1 :])


@worker("for (int i = first; i < last; ++i) out[i + offset] = 1.0f;", items="n", grain=4)
def leaky_fill(out: FloatArray, n: int, offset: int) -> None: ...


@pytest.mark.parametrize(
    ("offset", "message"),
    [(-1, "wrote 4 bytes before out"), (1, "wrote 4 bytes behind out"), (1000, "wrote 32 bytes behind out")],
)
def test_guard_zones_find_what_is_written_outside(offset: int, message: str) -> None:
    out = torch.zeros(8)
    with guard.at_least(guard.ZONES):
        leaky_fill(out, 8, 0)
        assert (out == 1).all()
        with pytest.raises(AssertionError, match=message):
            leaky_fill(out, 8, offset)


@worker("out[0] = source[at];", items="1", grain=1)
def peek(source: FloatArray, out: FloatArray, at: int) -> None: ...


def test_guard_zones_find_what_is_read_outside() -> None:
    source, out = torch.ones(8), torch.zeros(1)
    with guard.at_least(guard.ZONES):
        peek(source, out, 7)
        for at in (-1, 8):
            with pytest.raises(AssertionError, match="peek: out depends on memory outside"):
                peek(source, out, at)


def test_messages_of_the_compiler_name_our_file(capfd: pytest.CaptureFixture[str]) -> None:
    text = read_kernel("list_visible.h")
    broken = text.replace("int m = 0;", "int m = nothing;")
    assert text != broken
    kinds = project.list_visible._kinds

    def stub(seen: IntArray, block_count: IntArray, visible: IntArray, block_start: IntArray, blocks: int) -> None: ...

    found = worker(broken, items="1", grain=1, name="broken")(stub)
    with pytest.raises(Exception, match="build failed"):
        found(*[EXAMPLES[kind] for kind in kinds.values()])
    line = text.splitlines().index("int m = 0;")
    assert f"skipgs_plug/fallback_raster/kernels/list_visible.h:{line}:" in capfd.readouterr().err
