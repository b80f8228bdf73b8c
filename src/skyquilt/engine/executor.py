"""Parallel work with results in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")


def in_order(work: Callable[[A], B], items: Iterable[A], *, jobs: int) -> Iterator[B]:
    """work(item) for each item, in order, in `jobs` threads, computing at most a few results ahead
    of the consumer.

    The heavy parts (OpenCV, BLAS, the JPEG codec) release the interpreter lock. An interrupt
    cancels items that have not started and waits only for those being computed.
    """
    if jobs <= 1:
        for item in items:
            yield work(item)
        return
    pool = ThreadPoolExecutor(jobs)
    waiting: deque[Future[B]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > 2 * jobs:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
