"""Memory is reused only when no tensor uses it any more, and little more is kept than was needed at one time."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch

from skipgs_plug.fallback_raster.runtime import buffers, memory
from skipgs_plug.fallback_raster.runtime.memory import Pool

pytestmark = pytest.mark.skipif(not memory.SUPPORTED, reason="no private pages without a file here")
PAGE = 4096


@pytest.fixture
def pool() -> Pool:
    return Pool()


def numbers(pool: Pool, count: int = PAGE) -> torch.Tensor:
    return pool.empty((count,), torch.float32)


def test_a_tensor_that_died_makes_room_for_the_next(pool: Pool) -> None:
    address = numbers(pool).data_ptr()
    mapped = pool.mapped
    for count in (PAGE, PAGE - 100):
        assert numbers(pool, count).data_ptr() == address
    assert pool.mapped == mapped


def test_a_piece_serves_tensors_that_are_somewhat_longer_or_shorter(pool: Pool) -> None:
    address = numbers(pool, 80 * PAGE).data_ptr()
    for count in (85 * PAGE, 90 * PAGE, 73 * PAGE, 80 * PAGE):
        assert numbers(pool, count).data_ptr() == address
    mapped = pool.mapped
    kept = numbers(pool, 60 * PAGE)  # a third of the piece would be unused
    assert kept.data_ptr() != address and pool.mapped < 2 * mapped
    other = numbers(pool, 95 * PAGE)
    assert other.data_ptr() != address


@pytest.mark.parametrize(
    "hold",
    [
        lambda tensor: tensor.detach(),
        lambda tensor: tensor[5:9],
        lambda tensor: tensor.untyped_storage(),
        lambda tensor: (tensor * torch.ones(PAGE, requires_grad=True)).sum(),
    ],
    ids=["detached", "slice", "storage", "graph"],
)
def test_what_is_still_held_is_not_used_again(pool: Pool, hold: Callable[[torch.Tensor], Any]) -> None:
    tensor = numbers(pool).fill_(3.0)
    held = hold(tensor)
    address = tensor.data_ptr()
    del tensor
    other = numbers(pool).fill_(7.0)
    assert other.data_ptr() != address
    del held
    gc.collect()
    assert numbers(pool).data_ptr() == address


def test_little_more_is_mapped_than_was_in_use_at_one_time(pool: Pool) -> None:
    both = numbers(pool), numbers(pool, 3 * PAGE)
    most = pool.mapped
    del both
    for count in (2 * PAGE, 4 * PAGE, PAGE // 2, 3 * PAGE):  # sizes change like this in densification
        tensor = numbers(pool, count)
        assert pool.mapped <= most + most // memory.SPARE_DIVISOR
        del tensor


def test_an_iteration_like_the_last_maps_nothing(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Most memory is in use at the end of an iteration. Pieces that only its beginning needs fit no tensor then."""
    mapped, map_one = [], pool._map
    monkeypatch.setattr(pool, "_map", lambda size: mapped.append(size) or map_one(size))
    for _ in range(4):
        before = len(mapped)
        lists = numbers(pool, 16 * PAGE)
        kept = [numbers(pool, 40 * PAGE) for _ in range(3)]
        del lists
        gradients = [numbers(pool, 200 * PAGE), numbers(pool, 25 * PAGE)]
        del kept, gradients
    assert len(mapped) == before


def test_a_release_gives_back_what_is_free_alone(pool: Pool) -> None:
    kept, gone = numbers(pool).fill_(1.0), numbers(pool)
    half = pool.mapped // 2
    del gone
    pool.release()
    assert pool.mapped == half
    assert (kept == 1).all()
    del kept
    pool.release()
    assert pool.mapped == 0


def test_shapes_and_types(pool: Pool) -> None:
    for dtype in (torch.float32, torch.int32):
        tensor = pool.empty((40, 50, 2), dtype)
        assert tensor.shape == (40, 50, 2) and tensor.dtype is dtype and tensor.is_contiguous()
        assert tensor.is_cpu and tensor.data_ptr() % PAGE == 0 and not tensor._is_view()


def test_tensors_may_die_in_any_thread(pool: Pool) -> None:
    tensors = [numbers(pool) for _ in range(20)]
    threads = [threading.Thread(target=tensors.pop) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    mapped = pool.mapped
    again = [numbers(pool) for _ in range(20)]
    assert pool.mapped == mapped and len({tensor.data_ptr() for tensor in again}) == 20


def test_large_tensors_of_the_rasterizer_lie_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffers, "POOLED_BYTES", 4 * PAGE)
    monkeypatch.setattr(buffers, "_memory", Pool())
    small = buffers.floats(PAGE - 1)
    assert buffers._memory.mapped == 0
    address = buffers.ints(2, PAGE).data_ptr()
    assert buffers.floats(PAGE, 2).data_ptr() == address
    buffers.release_memory()
    assert buffers._memory.mapped == 0 and len(small) == PAGE - 1
