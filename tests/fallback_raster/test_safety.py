"""Calls that used to crash or hang the process, or to give a wrong image silently."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from raster_scenes import leaves, random_scene

from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
from skipgs_plug.fallback_raster.runtime import cache
from skipgs_plug.fallback_raster.runtime.cache import load_or_rebuild
from skipgs_plug.fallback_raster.runtime.constants import SPARE_COUNTS
from skipgs_plug.fallback_raster.stages import binning
from skipgs_plug.fallback_raster.stages.structs import grid
from skipgs_plug.fallback_raster.training.adam import adam_rows
from skipgs_plug.files import WriteError

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def run(*command: str, **environment: str) -> str:
    """Run Python in a new process, which must succeed, and return its output.

    It has no time limit of its own: pytest's --timeout ends the test, which kills it.
    """
    found = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE)]), **environment},
        cwd=ROOT,
    )
    assert found.returncode == 0, f"exit {found.returncode}\n{found.stdout[-3000:]}\n{found.stderr[-3000:]}"
    return found.stdout + found.stderr


INTERRUPTED = """
import gc, signal, time, torch
from raster_scenes import leaves, random_scene
from skipgs_plug.fallback_raster import rasterization, set_num_threads

set_num_threads(3)
class Alarm(Exception): pass
def handler(*_): raise Alarm
signal.signal(signal.SIGALRM, handler)
def once():
    inputs = leaves(random_scene(n=4000, width=200, height=150, sh_degree=2), torch.float32)
    rasterization(**inputs)[0].sum().backward()
    return inputs["means"].grad
truth, caught, end, k = once(), 0, time.monotonic() + 2, 0
while time.monotonic() < end:
    k += 1
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.001 + 0.0007 * (k % 40))
        once()
        signal.setitimer(signal.ITIMER_REAL, 0)
    except Alarm:
        caught += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
assert caught > 5, caught
assert torch.equal(once(), truth)
"""


INTERRUPTED_START = """
import _thread
from raster_scenes import random_scene
from skipgs_plug.fallback_raster import rasterization, set_num_threads

set_num_threads(3)
start, interrupts = _thread.start_new_thread, []
def interrupted_start(*arguments):
    start(*arguments)
    if not interrupts:
        interrupts.append(True)
        raise KeyboardInterrupt
_thread.start_new_thread = interrupted_start
try:
    rasterization(**random_scene(n=4000, width=200, height=150))
except KeyboardInterrupt:
    assert interrupts
    print("interrupted")
if AGAIN:
    rasterization(**random_scene(n=4000, width=200, height=150))
"""


@pytest.mark.parametrize("again", [False, True])
def test_a_process_interrupted_while_it_starts_threads_comes_to_its_end(again: bool) -> None:
    assert run("-c", f"AGAIN = {again}\n{INTERRUPTED_START}") == "interrupted\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs SIGALRM")
def test_signals_that_raise_at_any_time_do_not_crash() -> None:
    run("-c", INTERRUPTED)


def everything() -> list[torch.Tensor]:
    """Return image and gradients of the loss, and a step of Adam."""
    results = []
    for options in ({"packed": True, "absgrad": True}, {"packed": False, "render_mode": "RGB+ED"}):
        scene = {k: v.clone() if torch.is_tensor(v) else v for k, v in SCENE.items()}
        for name in ("means", "quats", "scales", "opacities", "colors", "viewmats"):
            scene[name].requires_grad_()
        image, _, _ = rasterization(**scene, **options)
        l1_ssim_loss(image, torch.full_like(image, 0.3)).backward()
        results += [image, *(t.grad for t in scene.values() if torch.is_tensor(t) and t.grad is not None)]
    param = torch.nn.Parameter(SCENE["means"].clone())
    param.grad = SCENE["scales"].clone()
    moments = torch.zeros_like(param.data), torch.zeros_like(param.data)
    adam_rows(SCENE["opacities"] > 0.3, param, *moments, 0.1, (0.9, 0.999), 1e-15)
    return [t.detach() for t in (*results, param)]


SCENE = random_scene(n=200, sh_degree=2, backgrounds=True)


@pytest.mark.parametrize("default", [torch.float64, torch.bfloat16, torch.float16, "meta"])
def test_defaults_of_the_process_change_nothing(default: Any) -> None:
    expected = everything()
    before = torch.get_default_dtype()
    try:
        if default == "meta":
            with torch.device("meta"):
                found = everything()
        else:
            torch.set_default_dtype(default)
            found = everything()
    finally:
        torch.set_default_dtype(before)
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in zip(found, expected, strict=True))


def test_pairs_are_counted_beyond_32_bits() -> None:
    counts = torch.full((2, 4 + SPARE_COUNTS), 2**30, dtype=torch.int32)
    totals = torch.tensor([2**32, 2**32, 0])
    binning.scan_pairs(
        counts=binning.PairCounts(counts, totals),
        tile_start=torch.zeros(5, dtype=torch.int32),
        grid=grid(32, 32),
        slices=binning.Slices(m=0, number=2),
    )
    assert totals.tolist() == [0, 2**32, 2**33]


def test_too_many_pairs_are_one_sentence_before_anything_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binning, "MAX_PAIRS", 100)
    monkeypatch.setattr(binning, "fill_pairs", lambda **_: pytest.fail("wrote"))
    with pytest.raises(
        ValueError, match=r"\d+ visible.* cover [0-9,]+ tiles of an image of 44x37 .* at most 100"
    ) as caught:
        rasterization(**{**random_scene(), "near_plane": 1e-6, "scales": torch.full((300, 3), 0.3)})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("width", "height"), [(2**25, 1), (1, 2**25), (2**20, 2**20)])
def test_images_beyond_what_kernels_can_count_are_refused(width: int, height: int) -> None:
    with pytest.raises(ValueError, match=f"8,388,608 pixels along a side .* got {width}x{height}"):
        rasterization(**{**random_scene(n=3), "width": width, "height": height})


@pytest.mark.parametrize(
    ("name", "sh_degree"), [("means", 1), ("quats", 1), ("scales", 1), ("colors", 1), ("colors", None)]
)
@pytest.mark.parametrize("n", [20, 200])
def test_data_replaced_between_forward_and_backward_is_an_error(name: str, sh_degree: int | None, n: int) -> None:
    inputs = leaves(random_scene(n=100, sh_degree=sh_degree), torch.float32)
    image, _, _ = rasterization(**inputs, packed=False)
    inputs[name].data = torch.ones(n, *inputs[name].shape[1:])
    with pytest.raises(RuntimeError, match=rf"{name} had shape \[100, .* has \[{n}, .* before the number"):
        image.sum().backward()


FORKED = """
import os, sys, threading, warnings, torch
from raster_scenes import random_scene
from skipgs_plug.fallback_raster import rasterization, set_num_threads

warnings.simplefilter("error", RuntimeWarning)
torch.set_num_threads(1)
set_num_threads(2)
scene, small = random_scene(n=20000, width=400, height=300), random_scene(n=20)
truth, stop = rasterization(**small)[0], threading.Event()
def render():
    while not stop.is_set():
        rasterization(**scene)
threading.Thread(target=render, daemon=True).start()
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 and newer advise against any fork with threads
    children = []
    for _ in range(8):
        child = os.fork()
        if child == 0:
            os._exit(0 if torch.equal(rasterization(**small)[0], truth) else 1)
        children.append(child)
assert all(os.waitpid(child, 0)[1] == 0 for child in children)
stop.set()
torch.set_num_threads(2)
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    child = os.fork()
if child == 0:
    try:
        rasterization(**small)
    except RuntimeWarning as warning:
        os._exit(0 if "spawn" in str(warning) else 2)
    os._exit(3)
assert os.waitpid(child, 0)[1] == 0
os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_while_another_thread_renders_can_render() -> None:
    run("-c", FORKED)


LISTED = """
import torch
from skipgs_plug.fallback_raster.stages.project import list_visible

seen, block_count = torch.tensor([0, 2, 7], dtype=torch.int32), torch.tensor([2], dtype=torch.int32)
visible, block_start = torch.empty(3, dtype=torch.int32), torch.empty(2, dtype=torch.int32)
list_visible(found=seen, block_count=block_count, visible=visible, block_start=block_start, blocks=1)
assert visible[:2].tolist() == [0, 2] and block_start.tolist() == [0, 2]
"""


def test_a_damaged_kernel_cache_is_rebuilt_and_compiling_prints_nothing(tmp_path: Path) -> None:
    def render() -> None:
        assert run("-c", LISTED, WARP_CACHE_PATH=str(tmp_path)) == ""

    render()
    (compiled,) = tmp_path.rglob("*.o")
    good = compiled.read_bytes()
    damaged = bytearray(good)
    for place in range(len(good) // 3, len(good), 7):
        damaged[place] ^= 0x55
    compiled.write_bytes(bytes(damaged))
    render()
    assert compiled.read_bytes() == good


def test_threads_that_need_warp_at_once_start_it_once() -> None:
    code = """
import threading, time
import warp
from skipgs_plug.fallback_raster.runtime.native import _warp

started, init = [], warp.init

def slow_init():
    started.append(threading.get_ident())
    time.sleep(0.3)
    init()

warp.init = slow_init
threads = [threading.Thread(target=_warp) for _ in range(4)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
assert len(started) == 1, started
"""
    run("-c", code)


def test_kernels_are_kept_in_a_temporary_folder_if_the_cache_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    places = {"WARP_CACHE_PATH": str(tmp_path / "file/cache"), "TMPDIR": str(tmp_path / "temporary")}
    said = run("-c", LISTED, **places)
    assert said.count("file/cache (Not a directory), and each process compiles them again: set WARP_CACHE_PATH") == 1
    assert list((tmp_path / "temporary").iterdir()) == []
    code = "import sys\nfrom skipgs_plug.commands.doctor import check_backend\ncheck_backend('warp')"
    (line,) = run("-c", code, **places).splitlines()
    assert "  ok  warp" in line and line.endswith("set WARP_CACHE_PATH to a folder that can be written.")


# The folder exists when Warp starts. Warp finds later that it cannot write there.
LATER = """
import warp
from skipgs_plug.fallback_raster.runtime.native import _warp

_warp().config.kernel_cache_dir += "/../../file/cache"
"""


def test_a_cache_that_cannot_be_written_later_ends_no_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said = run("-c", LATER + LISTED, WARP_CACHE_PATH=str(tmp_path / "cache"))
    assert said.count("each process compiles them again") == 1


def test_without_any_folder_the_fix_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(**_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(cache, "TemporaryDirectory", fails)
    monkeypatch.setattr(cache, "_temporary", [])
    refused = OSError(errno.EROFS, "Read-only file system", "/cache/kernel")
    sentence = r"in /cache/kernel \(Read-only file system\), and there is no temporary folder: set WARP_CACHE_PATH"
    with pytest.raises(WriteError, match=sentence):
        cache.in_temporary_folder(None, refused)


def test_what_does_not_load_is_compiled_again_once(tmp_path: Path) -> None:
    folder, calls = tmp_path / "kernel", []

    def load() -> str:
        calls.append("load")
        if not folder.exists():
            folder.mkdir()
            (folder / "kernel.o").write_bytes(b"good")
        if (folder / "kernel.o").read_bytes() != b"good":
            raise RuntimeError("Failed to load")
        return "kernel"

    def forget() -> None:
        calls.append("forget")

    assert load_or_rebuild(folder, load, forget) == "kernel" and calls == ["load"]
    assert load_or_rebuild(folder, load, forget) == "kernel" and calls == ["load"] * 2
    (folder / "kernel.o").write_bytes(b"bad")
    # The checksum differs, so the kernel is built again before it is loaded.
    assert load_or_rebuild(folder, load, forget) == "kernel" and calls == ["load"] * 3
    (folder / "kernel.o").write_bytes(b"bad")
    (folder / "kernel.sha256").unlink()
    calls.clear()
    assert load_or_rebuild(folder, load, forget) == "kernel" and calls == ["load", "forget", "load"]

    def broken() -> str:
        raise RuntimeError("does not compile")

    with pytest.raises(RuntimeError, match="does not compile"):
        load_or_rebuild(folder, broken, forget)


def test_kernels_stay_inside_their_buffers() -> None:
    """Run the core of the rasterizer's tests between guard zones. CI runs all of them so."""
    tests = ["test_against_reference.py", "test_adam.py", "test_threads.py"]
    chosen = "not tiles and not features and not near and not blur and not radius"
    options = ["-m", "pytest", "-q", "-x", "-k", chosen, "-p", "no:cacheprovider"]
    if os.environ.get("SKIPGS_PLUG_GUARD", "0") in ("", "0"):
        assert " passed" in run(*options, *(str(HERE / test) for test in tests), SKIPGS_PLUG_GUARD="1")
