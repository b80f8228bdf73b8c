import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cloudpickle
import numpy as np
import pytest

from skyquilt.engine import pixel_cache
from skyquilt.engine.pixel_cache import PhotoParts, PixelCache
from skyquilt.geometry import set_aside


def cache(budget, read=None):
    return PixelCache(read=read or (lambda i: np.full(100, i, np.uint8)), budget_bytes=budget)


def test_kept_while_there_is_room_then_the_oldest_goes():
    kept = cache(300)
    for i in (0, 1, 2, 0, 3):  # 0 was used last but one: 1 makes room
        assert kept(i)[0] == i
    assert kept.decoded == 4
    kept(0)
    kept(2)
    assert kept.decoded == 4
    kept(1)
    assert kept.decoded == 5


@pytest.mark.parametrize("budget", [0, 99])
def test_what_is_larger_than_the_budget_is_handed_out_and_not_kept(budget):
    small = cache(budget)
    assert small(4)[0] == 4
    assert small(4)[0] == 4
    assert small.decoded == 2


def test_pixels_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        cache(1000)(1)[0] = 7


def test_two_threads_that_want_one_photo_decode_it_once():
    def slow(i):
        time.sleep(0.05)
        return np.full(100, i, np.uint8)

    shared = cache(10_000, slow)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(shared, [3] * 8 + [4] * 8))
    assert shared.decoded == 2
    assert [int(f[0]) for f in found] == [3] * 8 + [4] * 8


def test_two_photos_are_decoded_at_the_same_time():
    both = threading.Barrier(2, timeout=5)

    def meet(i):
        both.wait()
        return np.full(100, i, np.uint8)

    shared = cache(10_000, meet)
    with ThreadPoolExecutor(2) as pool:
        assert [int(f[0]) for f in pool.map(shared, [1, 2])] == [1, 2]


def test_many_threads_never_exceed_the_budget():
    shared = cache(550)
    most = []

    def use(i):
        assert shared(i % 9)[0] == i % 9
        most.append(sum(p.nbytes for p in list(shared._kept.values())))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(use, range(800)))
    assert max(most) <= 550


def test_an_error_does_not_block_the_next_try():
    tries = []

    def flaky(i):
        tries.append(i)
        if len(tries) == 1:
            raise OSError("gone")
        return np.zeros(10)

    shared = cache(1000, flaky)
    with pytest.raises(OSError, match="gone"):
        shared(1)
    assert shared(1).shape == (10,)


def test_cleared():
    kept = cache(1000)
    kept(1)
    kept.clear()
    kept(1)
    assert kept.decoded == 2


def test_fewer_are_kept_while_other_things_fill_the_memory(monkeypatch):
    monkeypatch.setattr(pixel_cache, "LEAST_BYTES", 200)
    shared = PixelCache(read=lambda i: np.full(100, i, np.uint8), budget_bytes=600)
    shared.resident_bytes, other = 1000, 0
    monkeypatch.setattr(
        pixel_cache, "resident_bytes", lambda: other + sum(p.nbytes for p in shared._kept.values())
    )
    for i in range(8):
        shared(i)
    assert len(shared._kept) == 6  # the budget
    other = 700
    shared(8)
    assert len(shared._kept) == 3  # what is left
    other = 5000
    shared(9)
    assert list(shared._kept) == [8, 9]  # the least


def test_a_survey_that_does_not_fit_is_dropped_as_a_whole():
    kept = cache(300)
    for i in range(3):
        kept(i)
    kept.make_room()
    assert kept.peek(0) is not None
    kept(3)
    kept.make_room()
    assert all(kept.peek(i) is None for i in range(4))
    assert kept(3)[0] == 3


def test_what_is_asked_for_once_is_not_kept_where_not_all_fit():
    fits = cache(300)
    assert [fits.once(i)[0] for i in (0, 1, 2)] == [0, 1, 2]
    assert fits.decoded == 3 and fits.once(1) is fits.peek(1)
    full = cache(300)
    for i in range(4):
        full(i)
    assert full.once(9)[0] == 9 and full.peek(9) is None
    assert full.once(3) is full.peek(3)
    full.make_room()
    assert full.once(3)[0] == 3 and full.peek(3) is None


def photo(number):
    """20 rows and 30 columns, each pixel with a value of its own."""
    return (1000 * number + np.arange(600)).reshape(20, 30)


def parts_of(asked, budget=10**6):
    read = []

    def decode(number):
        read.append(number)
        return photo(number)

    return PhotoParts(decode, asked, cache(budget)), read


def test_of_a_photo_only_what_steps_still_ask_for_is_kept():
    early, late = (slice(0, 4), slice(0, 5)), (slice(6, 10), slice(10, 20))
    parts, read = parts_of({7: {(0, 0): early, (0, 1): late}})
    assert np.array_equal(parts(7, *early), photo(7)[early])
    assert parts._kept.peek(7).pixels.shape == (10, 20)
    parts.done((0, 0))
    assert parts._kept.peek(7).pixels.shape == (4, 10)
    assert np.array_equal(parts(7, slice(7, 9), slice(11, 20)), photo(7)[7:9, 11:20])
    with pytest.raises(ValueError, match="read-only"):
        parts(7, *late)[0, 0] = 1
    parts.done((0, 1))
    assert parts._kept.peek(7) is None and read == [7]


@pytest.mark.parametrize("asked", [{}, {7: {(0, 0): (slice(0, 4), slice(0, 5))}}])
def test_what_was_not_foreseen_is_decoded_again_and_then_kept(asked):
    parts, read = parts_of(asked)
    for box in (
        (slice(0, 4), slice(0, 5)),
        (slice(2, 12), slice(3, 9)),
        (slice(0, 12), slice(0, 9)),
    ):
        assert np.array_equal(parts(7, *box), photo(7)[box])
    assert read == ([7, 7] if asked else [7])


BOX = (slice(0, 10), slice(0, 10))


def test_parts_that_give_way_to_others_wait_in_files():
    parts, read = parts_of({i: {(0, 0): BOX} for i in range(4)}, budget=2 * 800)
    for i in (0, 1, 0, 2, 0, 1, 3, 2):
        assert np.array_equal(parts(i, *BOX), photo(i)[BOX])
    assert read == [0, 1, 2, 3] and parts._kept._bytes == 2 * 800
    with pytest.raises(ValueError, match="read-only"):
        parts(1, *BOX)[0, 0] = 1
    parts.done((0, 0))
    assert not parts._aside and not parts._kept._kept


def test_of_photos_that_fill_the_memory_alone_none_stays_there(monkeypatch):
    monkeypatch.setattr(pixel_cache, "LEAST_BYTES", 700)
    parts, read = parts_of({i: {(0, 0): BOX, (0, 1): BOX} for i in range(2)})
    for step in ((0, 0), (0, 1)):
        for i in (0, 1):
            assert np.array_equal(parts(i, *BOX), photo(i)[BOX])
        assert parts._kept._bytes == 0 and len(parts._aside) == 2
        parts.done(step)
    assert read == [0, 1] and not parts._aside and not parts._kept._kept


@pytest.mark.parametrize("fault", ["full", "refused", "gone"])
def test_without_room_on_disk_photos_are_decoded_again(monkeypatch, fault):
    def refuses(*_, **__):
        raise OSError(fault)

    if fault == "full":
        monkeypatch.setattr(pixel_cache, "LEFT_FREE_BYTES", 2**62)
    elif fault == "refused":
        monkeypatch.setattr(set_aside, "TemporaryFile", refuses)
    else:
        monkeypatch.setattr(pixel_cache.shutil, "disk_usage", refuses)
    parts, read = parts_of({i: {(0, 0): BOX} for i in range(4)}, budget=2 * 800)
    for i in (0, 1, 0, 2, 0, 1):
        assert np.array_equal(parts(i, *BOX), photo(i)[BOX])
    assert read == [0, 1, 2, 1] and parts._kept._bytes == 2 * 800


def test_what_a_part_in_a_file_lacks_is_decoded_again():
    parts, read = parts_of({i: {(0, 0): BOX} for i in range(3)}, budget=800)
    for i in (0, 1, 2):
        parts(i, *BOX)
    wider = (slice(0, 12), slice(2, 20))
    assert np.array_equal(parts(0, *wider), photo(0)[wider])
    assert read == [0, 1, 2, 0]


def test_a_copy_for_another_process_begins_empty():
    parts, read = parts_of({i: {(0, 0): BOX} for i in range(3)}, budget=800)
    for i in (0, 1, 2):
        parts(i, *BOX)
    copy = pickle.loads(cloudpickle.dumps(parts))
    assert not copy._aside and not copy._kept._kept
    assert np.array_equal(copy(1, *BOX), photo(1)[BOX]) and read == [0, 1, 2]


def test_threads_share_parts_in_files():
    parts, read = parts_of({i: {(0, 0): BOX} for i in range(6)}, budget=800)
    with ThreadPoolExecutor(8) as pool:
        found = pool.map(
            lambda i: np.array_equal(parts(i % 6, *BOX), photo(i % 6)[BOX]), range(600)
        )
        assert all(found)
    assert len(read) <= 6 * 8
