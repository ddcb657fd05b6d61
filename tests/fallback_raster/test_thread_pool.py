"""Helpers run a kernel together with the caller, which returns when the last of them has finished."""

from __future__ import annotations

import ctypes
import random
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skipgs_plug import fallback_raster
from skipgs_plug.fallback_raster.runtime.native import Kernel
from skipgs_plug.fallback_raster.runtime.thread_pool import ThreadPool

SPIN_SECONDS = 2e-4  # approximate time after which spinning threads sleep


class Arguments(ctypes.Structure):
    _fields_ = (("number", ctypes.c_int32),)


def kernel(work: Callable[[int], None]) -> Kernel:
    """A kernel that calls Python with the number in its arguments."""

    def body(bounds: int, arguments: int) -> None:
        assert bounds == 7
        work(Arguments.from_address(arguments).number)

    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(body)
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return Kernel(function, None, Arguments, (address, 7), function)


@pytest.fixture(params=[1, 3])
def pool(request: pytest.FixtureRequest) -> Iterator[ThreadPool]:
    pool = ThreadPool(request.param)
    yield pool
    pool.dismiss()


def test_all_that_began_are_done_when_a_launch_returns(pool: ThreadPool) -> None:
    lengths = random.Random(0)
    begun: list[tuple[int, int]] = []
    ended: list[tuple[int, int]] = []

    def work(number: int) -> None:
        me = number, threading.get_ident()
        begun.append(me)
        time.sleep(lengths.choice([0, 0, SPIN_SECONDS / 10, SPIN_SECONDS, 4 * SPIN_SECONDS]))
        ended.append(me)

    working = kernel(work)
    for number in range(400):
        pool.run(working, bytes(Arguments(number)))
        assert sorted(begun) == sorted(ended)
        mine = [thread for launch, thread in ended if launch == number]
        assert threading.get_ident() in mine
        assert len(set(mine)) == len(mine) <= 1 + pool._count
        if number % 3 == 0:  # helpers fall asleep before some launches
            time.sleep(lengths.choice([SPIN_SECONDS / 10, 3 * SPIN_SECONDS]))
    assert len({thread for _, thread in ended}) == 1 + pool._count


def test_helpers_that_sleep_are_woken(pool: ThreadPool) -> None:
    together = threading.Barrier(1 + pool._count)
    meeting = kernel(lambda _: together.wait(10) and None)
    for _ in range(3):
        time.sleep(20 * SPIN_SECONDS)
        pool.run(meeting, bytes(Arguments(0)))
    assert not together.broken


def test_a_caller_waits_for_helpers_that_take_long(pool: ThreadPool) -> None:
    caller, ended = threading.get_ident(), []
    started = threading.Event()

    def work(_: int) -> None:
        if threading.get_ident() == caller:
            assert started.wait(10)
        else:
            started.set()
            time.sleep(0.05)
            ended.append(True)

    pool.run(kernel(work), bytes(Arguments(0)))
    assert ended


def test_who_is_dismissed_is_gone_and_may_be_dismissed_again() -> None:
    pool = ThreadPool(4)
    pool.run(kernel(lambda _: None), bytes(Arguments(0)))
    pool.dismiss()
    assert not pool._alive and not pool._locks
    pool.dismiss()


def test_no_kernel_holds_inline_assembly():
    """The compiler inside Warp has no assembler for aarch64: one such line ends the process natively."""
    for file in Path(fallback_raster.__file__).parent.rglob("*.h"):
        assert not re.search(r"\b(asm|__asm__)\b", re.sub(r"//.*", "", file.read_text())), file.name
