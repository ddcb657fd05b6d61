"""Memory that a script frees is kept for its next tensors."""

import ctypes
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from skipgs_plug.scripts.kept_memory import freed_memory_kept

SIZE = 1 << 28
GLIBC = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt")


def resident() -> int:
    """Return the bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) << 12


def use_and_free() -> None:
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    block = ctypes.c_void_p(libc.malloc(ctypes.c_size_t(SIZE)))
    ctypes.memset(block, 1, SIZE)
    libc.free(block)


@pytest.mark.skipif(not GLIBC, reason="needs the malloc of glibc")
def test_a_large_freed_block_stays_in_the_process_until_the_end() -> None:
    before = resident()
    use_and_free()
    assert resident() - before < SIZE / 4  # as without the block
    with freed_memory_kept():
        use_and_free()
        kept = resident()
        use_and_free()
        assert kept - before > SIZE / 2 and resident() - kept < SIZE / 4
    assert resident() - before < SIZE / 4


def test_malloc_has_its_initial_values_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    values: dict[int, int] = {}
    fake = SimpleNamespace(mallopt=values.__setitem__, malloc_trim=values.get)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: fake)
    with freed_memory_kept():
        inside = dict(values)
    assert inside == {-4: 0, -1: -1} and values == {-4: 65_536, -1: 131_072}


@pytest.mark.parametrize(("platform", "fake"), [("linux", object()), ("win32", SimpleNamespace(mallopt=None))])
def test_other_c_libraries_are_left_alone(platform: str, fake: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: fake)
    with freed_memory_kept():
        pass
