"""What the codec's kernels leave out or take together changes no byte."""

from fractions import Fraction
from math import floor

import numpy as np
import pytest
from codec_samples import KARLSRUHE, street

from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.codec import voxel_kernels as v
from gnd.gnd_map.codec.lattice import Quantised, integers_of
from gnd.gnd_map.codec.prior_sets import sets_of
from gnd.gnd_map.codec.priors import priors_of
from gnd.gnd_map.codec.range_tile import _best_set, _laid_out, _written, written

STANDARD = LATTICES["standard"]


@pytest.fixture(scope="module")
def tile() -> Quantised:
    return integers_of(snap(street(KARLSRUHE, np.random.default_rng(5), 500), STANDARD), STANDARD)


def test_a_mean_of_up_to_four_is_the_nearest_integer_as_of_any_quotient() -> None:
    totals = [*range(-200, 201), 2**31 + 1, -(2**31) - 1, 2**58 + 3, -(2**58) - 3]
    for n in range(1, 5):
        for total in totals:
            nearest = floor(Fraction(total, n) + Fraction(1, 2))
            assert v._mean.py_func(total, n) == nearest == v._ratio.py_func(total, n), (total, n)


def test_buckets_are_lengths_in_bits_up_to_five() -> None:
    for value in (*range(-70, 71), 2**40, -(2**40)):
        assert v._bucket.py_func(value) == min(abs(value).bit_length(), 5)


def test_neighbours_that_cannot_be_known_yet_are_left_out_and_no_byte_changes(
    tile: Quantised, monkeypatch: pytest.MonkeyPatch
) -> None:
    all_of_them, before = v.neighbours(1000, 50, only_before=False), v.neighbours(1000, 50, only_before=True)
    assert len(all_of_them) == v.NEIGHBOURS
    assert before.tolist() == [step for step in all_of_them.tolist() if step < 0]
    three, five = priors_of("tile-standard"), sets_of("standard")[1]
    expected = [
        written(KARLSRUHE, tile, STANDARD, three, five=False).finish(),
        written(KARLSRUHE, tile, STANDARD, five, five=True).finish(),
    ]
    every = v.neighbours.__wrapped__
    monkeypatch.setattr(v, "neighbours", lambda floors, lines, **_: every(floors, lines, only_before=False))
    assert written(KARLSRUHE, tile, STANDARD, three, five=False).finish() == expected[0]
    assert written(KARLSRUHE, tile, STANDARD, five, five=True).finish() == expected[1]


def test_a_tile_that_is_laid_out_once_is_written_alike_each_time(tile: Quantised) -> None:
    laid_out = _laid_out(KARLSRUHE, tile, STANDARD)
    for priors in (*sets_of("standard"), *sets_of("standard")):
        expected = written(KARLSRUHE, tile, STANDARD, priors, five=True).finish()
        assert _written(laid_out, priors, five=True).finish() == expected
    three = priors_of("tile-standard")
    expected = written(KARLSRUHE, tile, STANDARD, three, five=False).finish()
    assert _written(laid_out, three, five=False).finish() == expected


def test_the_set_that_is_chosen_is_the_one_that_makes_a_small_tile_shortest(tile: Quantised) -> None:
    small = tile.take(np.arange(100))
    sizes = [len(written(KARLSRUHE, small, STANDARD, one, five=True).finish()) for one in sets_of("standard")]
    assert len(set(sizes)) > 1
    assert _best_set(KARLSRUHE, small, STANDARD) == int(np.argmin(sizes))
