"""Promises of Gaussians are remembered within bounds, for a bounded time."""

import numpy as np
import pytest
from merger_world import NEIGHBOUR, TILE

from gnd.cloud_merger import waiting
from gnd.cloud_merger.waiting import Promises

SECOND = 1_000_000_000


class Clock:
    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def asked(*voxels, tile=TILE):
    return {tile: np.array(voxels, np.int32)}


def test_what_was_asked_of_others_is_promised_and_own_is_not(clock):
    promises = Promises(clock)
    promises.note("a", "ndt", asked(3, 4))
    promises.note("b", "ndt", asked(4))
    promises.note("c", "ndt_other", asked(4))
    assert sorted(promises.of(TILE, "ndt", but="c").tolist()) == [3, 4, 4]
    assert promises.of(TILE, "ndt", but="b").tolist() == [3, 4]
    assert promises.of(NEIGHBOUR, "ndt", but="c").tolist() == []


def test_the_oldest_make_room(clock, monkeypatch):
    monkeypatch.setattr(waiting, "MOST_REPORTS", 2)
    promises = Promises(clock)
    for number, name in enumerate("abc"):
        promises.note(name, "ndt", asked(number))
    assert promises.of(TILE, "ndt", but="").tolist() == [1, 2]


def test_a_promise_that_is_not_kept_in_time_counts_no_more(clock):
    promises = Promises(clock)
    promises.note("a", "ndt", asked(1))
    clock.now = int(waiting.KEEP_S) * SECOND
    assert promises.of(TILE, "ndt", but="").tolist() == [1]
    clock.now += 1
    assert promises.of(TILE, "ndt", but="").tolist() == []


def test_a_promise_that_was_kept_is_forgotten(clock):
    promises = Promises(clock)
    promises.note("a", "ndt", asked(1))
    promises.forget("a")
    promises.forget("never there")
    assert len(promises) == 0
