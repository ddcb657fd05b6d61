"""Threads that start inside the block enter its context manager; threads that start afterwards do not."""

import threading
from contextlib import contextmanager

from skipgs_plug.scripts.threads import also_in_threads

here = threading.local()


@contextmanager
def marked():
    here.mark = True
    yield
    del here.mark


def mark_of(make_thread):
    seen = []
    thread = make_thread(lambda: seen.append(hasattr(here, "mark")))
    thread.start()
    thread.join(timeout=60)
    return seen


class Trainer(threading.Thread):
    """A thread with a `run` of its own."""

    def __init__(self, work):
        super().__init__()
        self.work = work

    def run(self):
        self.work()


def plain(work):
    return threading.Thread(target=work)


def test_every_kind_of_thread_enters():
    start = threading.Thread.start
    with also_in_threads(marked):
        assert mark_of(plain) == mark_of(Trainer) == mark_of(lambda work: threading.Timer(0, work)) == [True]
        assert not hasattr(here, "mark")
    assert threading.Thread.start is start
    assert mark_of(plain) == mark_of(Trainer) == [False]


def test_a_thread_that_a_thread_starts_enters():
    with also_in_threads(marked):
        inner = []
        mark_of(lambda work: plain(lambda: inner.extend(mark_of(plain))))
    assert inner == [True]


def test_a_finished_thread_is_not_kept():
    with also_in_threads(marked):
        thread = Trainer(lambda: None)
        thread.start()
        thread.join(timeout=60)
    assert "run" not in vars(thread)
