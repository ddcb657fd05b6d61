"""Photographs of a capture that is too large for memory when decoded: some stay, others are decoded ahead of use.

2,000 photographs of 12 megapixels take 72 GB decoded. Each photograph is decoded once while the scene loads, so that a
damaged file is found before training begins. The first ones stay in memory, up to three quarters of the bound. The
others are decoded again for each use, on separate threads, in the order in which training needs them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from torch import Tensor

from skipgs_plug.fallback_raster import usable_cores
from skipgs_plug.limits import free_memory
from skipgs_plug.trainer.order import ViewOrder
from skipgs_plug.trainer.scene import View

T = TypeVar("T")
Picture = tuple[Tensor, Tensor | None]  # pixels [H, W, 3] uint8, mask [H, W] bool
SHARE_OF_FREE = 4  # by default, photographs take at most a quarter of the free memory, since the model needs the rest
SHARE_AHEAD = 4  # a quarter of the bound is for photographs that are decoded ahead of use
MOST_AHEAD = 64  # photographs decoded ahead, at most: more would only take memory
CORES_PER_THREAD = 4  # one decoding thread per four cores: decoding takes a small part of an iteration's time


class StreamedView(View):
    """A view whose photograph is decoded when it is needed, or a little earlier."""

    def __init__(self, view: View, store: ImageStore, load: Callable[[], Picture]) -> None:
        self.name, self.K, self.viewmat = view.name, view.K, view.viewmat
        self.bytes = picture_bytes(view)
        self.load = load
        self.store = store
        self._size = view.width, view.height
        self._masked, self._blank = view.mask is not None, view.blank

    @property
    def image(self) -> Tensor:  # type: ignore[override]
        return self.store.get(self)[0]

    @property
    def mask(self) -> Tensor | None:  # type: ignore[override]
        return self.store.get(self)[1] if self._masked else None

    @property
    def width(self) -> int:
        return self._size[0]

    @property
    def height(self) -> int:
        return self._size[1]

    @property
    def blank(self) -> bool:
        return self._blank


class ImageStore:
    """Holds the decoded photographs of a scene in bounded memory.

    Args:
        capacity: Bytes of decoded photographs and masks; None for a quarter of the free memory. The photograph in use
            and one photograph per decoding thread come on top.
        progress: Show a progress bar if reading takes longer than two seconds.
    """

    def __init__(self, capacity: int | None = None, progress: bool = False) -> None:
        self.capacity = free_memory() // SHARE_OF_FREE if capacity is None else capacity
        self._progress = progress
        self._window = self.capacity // SHARE_AHEAD
        self._resident = 0
        self._ahead: dict[str, Future[Picture]] = {}
        self._last: str | None = None  # view that was requested out of turn
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None

    def reading(self, items: Sequence[T]) -> Iterator[T]:
        """Iterate over items, with a progress bar if it takes long."""
        from tqdm.auto import tqdm

        return iter(tqdm(items, desc="Reading photographs", unit="", delay=2.0, disable=not self._progress))

    def keep(self, view: View, load: Callable[[], Picture]) -> View:
        """Return the view itself if there is room, else a view that calls `load` when it is needed."""
        size = picture_bytes(view)
        if self._resident + size <= self.capacity - self._window:
            self._resident += size
            return view
        return StreamedView(view, self, load)

    def expect(self, views: Iterable[View]) -> None:
        """Decode these views, which are needed next in this order, as far as there is room. Forget all others."""
        room = self._window
        wanted: dict[str, StreamedView] = {}
        for view in views:
            if isinstance(view, StreamedView) and view.name not in wanted:
                room -= view.bytes
                if room < 0 and wanted:
                    break
                wanted[view.name] = view
        with self._lock:
            for name in self._ahead.keys() - wanted.keys() - {self._last}:
                self._ahead.pop(name).cancel()
            for name, view in wanted.items():
                if name not in self._ahead:
                    self._ahead[name] = self._submit(view.load)

    def get(self, view: StreamedView) -> Picture:
        """Return the photograph and its mask, decoded before or now.

        Raises:
            InputError: The file has become unreadable since the scene was loaded.
        """
        with self._lock:
            found = self._ahead.get(view.name)
            if found is None:
                if self._last is not None:
                    self._ahead.pop(self._last, None)
                found = self._ahead[view.name] = self._submit(view.load)
                self._last = view.name
        return found.result()

    def _submit(self, load: Callable[[], Picture]) -> Future[Picture]:
        if self._pool is None:
            threads = max(1, usable_cores() // CORES_PER_THREAD)
            self._pool = ThreadPoolExecutor(threads, thread_name_prefix="skipgs_plug images")
        return self._pool.submit(load)


class ReadAhead:
    """Tells the store which views come next. It does nothing if all views stay in memory."""

    def __init__(self, views: Sequence[View], seed: int) -> None:
        self._views = views
        self._store = next((view.store for view in views if isinstance(view, StreamedView)), None)
        self._this, self._next = ViewOrder(len(views), seed), ViewOrder(len(views), seed)

    def expect(self, ran: int) -> None:
        """Tell the store that an iteration begins, after `ran` others."""
        if self._store is None:
            return
        epoch = ran // len(self._views)  # each order keeps the permutation of one epoch
        upcoming = range(ran, ran + min(MOST_AHEAD, len(self._views)))
        orders = ((self._this if n // len(self._views) == epoch else self._next, n) for n in upcoming)
        self._store.expect([self._views[order.at(n)] for order, n in orders])

    def end(self) -> None:
        """Stop decoding ahead: no iteration follows, and decoding would delay the end of the process."""
        if self._store is not None:
            self._store.expect([])


def one_by_one(views: Sequence[View]) -> Iterator[View]:
    """Iterate over views of one scene. While one is used, the next ones are decoded."""
    store = next((view.store for view in views if isinstance(view, StreamedView)), None)
    if store is None:
        yield from views
        return
    try:
        for i, view in enumerate(views):
            store.expect(views[i : i + MOST_AHEAD])
            yield view
    finally:
        store.expect([])


def picture_bytes(view: View) -> int:
    return view.image.nbytes + (0 if view.mask is None else view.mask.nbytes)
