"""Wrong kernel calls raise errors: every argument of every kernel is checked before the launch."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import pytest
import torch
from compat_scenes import camera, gaussians
from raster_scenes import deep_scene, leaves, random_scene

from skipgs_plug.compat import statistics
from skipgs_plug.compat.compose import render, splats
from skipgs_plug.compat.inria import GaussianRasterizationSettings
from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
from skipgs_plug.fallback_raster.declarations import workers
from skipgs_plug.fallback_raster.runtime import guard
from skipgs_plug.fallback_raster.runtime.launch import Worker, worker
from skipgs_plug.fallback_raster.runtime.parameters import (
    ArrayKind,
    Field,
    FloatArray,
    FloatOutput,
    IntArray,
    IntOutput,
)
from skipgs_plug.fallback_raster.runtime.source import KERNELS, PRELUDE, read_kernel
from skipgs_plug.fallback_raster.splats import rasterize_splats
from skipgs_plug.fallback_raster.stages import project
from skipgs_plug.fallback_raster.training import adam, gradient_norms, lazy_adam
from skipgs_plug.fallback_raster.training.factored_gradient import FactoredGradient, Factors

WORKERS = workers()
DTYPES = (torch.float32, torch.int32, torch.int64, torch.uint8)


def test_every_kernel_file_is_used_and_tested() -> None:
    texts = [PRELUDE, read_kernel("pool_serve.h"), read_kernel("pool_run.h")]
    texts += [found.text for found in WORKERS.values()]
    files = [path.relative_to(KERNELS).as_posix() for path in KERNELS.rglob("*.h")]
    unused = [file for file in files if not any(f'kernels/{file}"' in text for text in texts)]
    assert not unused
    assert len(WORKERS) == 32


@worker("out[0] = small; out[1] = large; numbers[0] = 2 * number; numbers[1] = most;", items="1", grain="1")
def _echo(out: FloatOutput, numbers: IntOutput, small: float, number: int, large: float, most: int) -> None: ...


@pytest.mark.parametrize("large", [1e39, -1e39, float("inf"), 3e38, 1e-50])
def test_numbers_arrive_as_they_are_and_beyond_float32_as_infinity(large: float) -> None:
    out, numbers = torch.zeros(2), torch.zeros(2, dtype=torch.int32)
    _echo(out, numbers, 0.1, -7, large, 2**31 - 1)
    assert torch.equal(out, torch.tensor([0.1, large], dtype=torch.float64).to(torch.float32))
    assert numbers.tolist() == [-14, 2**31 - 1]


class Camera(NamedTuple):
    matrix: Annotated[FloatArray, "4, 4"]
    width: int


class Rows(NamedTuple):
    rows: Annotated[IntArray, "M"]
    block_start: Annotated[IntArray, "blocks + 1"]


# The first number of each list, and the numbers of the camera.
@worker(
    "out[0] = near.rows[0]; out[1] = far.rows[0]; out[2] = (int)camera.matrix[0]; out[3] = camera.width;",
    items="1",
    grain="1",
)
def _echo_structs(
    *,
    camera: Camera,
    near: Rows,
    far: Rows,
    image: Annotated[FloatArray, "camera.width"],
    taken: Annotated[FloatArray, "near.M"],
    out: Annotated[IntOutput, "4"],
    blocks: int,
) -> None: ...


def structs() -> dict[str, Any]:
    lists = [Rows(torch.full((m,), m, dtype=torch.int32), torch.zeros(3, dtype=torch.int32)) for m in (5, 7)]
    return {
        "camera": Camera(torch.full((4, 4), 3.0), 6),
        "near": lists[0],
        "far": lists[1],
        "image": torch.zeros(6),
        "taken": torch.zeros(5),
        "out": torch.zeros(4, dtype=torch.int32),
        "blocks": 2,
    }


def test_structs_arrive_field_by_field_whatever_the_order_of_the_names() -> None:
    for names in (structs(), dict(reversed(structs().items()))):
        _echo_structs(**names)
        assert names["out"].tolist() == [5, 7, 3, 6]


def test_arguments_are_checked_by_name() -> None:
    with pytest.raises(TypeError, match=r"_echo_structs\(\) missing 1 required keyword-only argument: 'far'"):
        _echo_structs(**{name: value for name, value in structs().items() if name != "far"})
    with pytest.raises(TypeError, match=r"_echo_structs\(\) got an unexpected keyword argument 'further'"):
        _echo_structs(**structs(), further=1)
    with pytest.raises(TypeError, match=r"_echo_structs\(\) takes 0 positional arguments but 7 were given"):
        _echo_structs(*structs().values())
    for wrong in (None, tuple(structs()["near"]), structs()["camera"]):
        with pytest.raises(TypeError, match=r"^_echo_structs: near must be a Rows, got "):
            _echo_structs(**structs() | {"near": wrong})
    with pytest.raises(TypeError, match=r"^_echo_structs: camera.matrix must be a contiguous tensor of torch.float32"):
        _echo_structs(**structs() | {"camera": Camera(torch.zeros(4, 4).t().double(), 6)})
    with pytest.raises(TypeError, match=r"^_echo_structs: camera.width must be a int, got float 6.0"):
        _echo_structs(**structs() | {"camera": Camera(torch.zeros(4, 4), 6.0)})  # type: ignore[arg-type]


def test_each_struct_has_its_own_sizes_and_parameters_may_name_them() -> None:
    ints = torch.zeros(3, dtype=torch.int32)
    for name, wrong, message in (
        ("camera", Camera(torch.zeros(3, 4), 6), r"camera.matrix holds 12 numbers, but \[4, 4\] makes 16"),
        ("far", Rows(ints, ints[:2]), r"far.block_start holds 2 numbers, but \[blocks \+ 1\] makes 3"),
        ("image", torch.zeros(5), r"image holds 5 numbers, but \[camera.width\] makes 6"),
        ("taken", torch.zeros(7), r"taken holds 7 numbers, but \[near.M\] makes 5"),
    ):
        with pytest.raises(ValueError, match=f"^_echo_structs: {message}"):
            _echo_structs(**structs() | {name: wrong})


def test_what_a_kernel_reads_it_cannot_write(capfd: pytest.CaptureFixture[str]) -> None:
    @worker("source[0] = 1.0f;", items="1", grain="1")
    def overwrites(source: FloatArray) -> None: ...

    with pytest.raises(Exception, match="build failed"):
        overwrites(torch.zeros(1))
    assert "cannot assign to variable 'source' with const-qualified" in capfd.readouterr().err


def example(field: Field) -> Any:
    return torch.zeros(0, dtype=field.kind.dtype) if isinstance(field.kind, ArrayKind) else field.kind(0)


def examples(found: Worker[Any], /, **fields: Any) -> dict[str, Any]:
    """Return arguments of the declared kinds, with some fields replaced by path."""
    arguments = {}
    for parameter in found._parameters:
        values = [fields.get(field.path, example(field)) for field in parameter.fields]
        arguments[parameter.name] = parameter.struct(*values) if parameter.struct else values[0]
    return arguments


@pytest.mark.parametrize("name", WORKERS)
def test_misuse_is_an_error_that_names_kernel_and_argument(name: str) -> None:
    found = WORKERS[name]
    valid = examples(found)
    for missing in valid:
        with pytest.raises(TypeError, match=rf"{name}\(\) missing 1 required .*argument: '{missing}'"):
            found(**{other: value for other, value in valid.items() if other != missing})
    with pytest.raises(TypeError, match=rf"{name}\(\) got an unexpected keyword argument 'further'"):
        found(**valid, further=0)
    for field in found._fields:
        wrong_values: list[Any] = [None, "1", [1.0]]
        if isinstance(field.kind, ArrayKind):
            square = torch.zeros(3, 3, dtype=field.kind.dtype)
            wrong_values += [1, 0.0, square.t(), square.to("meta"), square.numpy()]
            wrong_values += [square.to(dtype) for dtype in (torch.float64, torch.int16, torch.bool)]
            wrong_values += [square.to(dtype) for dtype in DTYPES if dtype is not field.kind.dtype]
        else:
            wrong_values += [square_one(field.kind), True, 1.0 if field.kind is int else 1]
        for value in wrong_values:
            with pytest.raises(TypeError, match=f"{name}: {field.path} must be a "):
                found(**examples(found, **{field.path: value}))


def square_one(kind: type) -> torch.Tensor:
    return torch.ones((), dtype=torch.int32 if kind is int else torch.float32)


def test_a_number_beyond_32_bits_is_refused() -> None:
    with pytest.raises(OverflowError, match="list_visible: blocks = 2147483648"):
        project.list_visible(**examples(project.list_visible, blocks=2**31))


def recorded_calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Worker[Any], dict[str, Any]]]:
    """Return the workers that ran, and the fields of their arguments by path."""
    calls: dict[str, tuple[Worker[Any], dict[str, Any]]] = {}
    original = Worker.__call__

    def record(self: Worker[Any], *arguments: Any, **named: Any) -> None:
        calls[self.name] = self, self.fields_of(*arguments, **named)
        original(self, *arguments, **named)

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
    assert {found.name for found, _ in calls} == set(WORKERS)
    # No other argument of a call determines these sizes, or only up to a whole vector.
    free = {("reduce_pairs", "sums.pair_slot"), ("splat_adjoint", "sums.pair_slot")}
    for found, arguments in calls:
        for path, value in arguments.items():
            if not isinstance(value, torch.Tensor) or not value.numel() or (found.name, path) in free:
                continue
            flat = value.detach().flatten()
            for wrong in (flat[:-1], torch.cat([flat, flat[:1]])):
                with pytest.raises(ValueError, match=f"^{found.name}: "):
                    found(**examples(found, **arguments | {path: wrong}))


@worker("for (int i = first; i < last; ++i) out[i + offset] = 1.0f;", items="n", grain=4)
def leaky_fill(out: FloatOutput, n: int, offset: int) -> None: ...


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
def peek(source: FloatArray, out: FloatOutput, at: int) -> None: ...


def test_guard_zones_find_what_is_read_outside() -> None:
    source, out = torch.ones(8), torch.zeros(1)
    with guard.at_least(guard.ZONES):
        peek(source, out, 7)
        for at in (-1, 8):
            with pytest.raises(AssertionError, match="peek: out depends on memory outside"):
                peek(source, out, at)


def test_messages_of_the_compiler_name_our_file(capfd: pytest.CaptureFixture[str]) -> None:
    text = (KERNELS / "list_visible.h").read_text(encoding="utf-8")
    broken = read_kernel("list_visible.h").replace("int m = 0;", "int m = nothing;")
    found = worker(broken, items="1", grain=1, name="broken")(lambda: None)
    with pytest.raises(Exception, match="build failed"):
        found()
    line = text.splitlines().index("    int m = 0;") + 1
    assert f"skipgs_plug/fallback_raster/kernels/list_visible.h:{line}:" in capfd.readouterr().err
