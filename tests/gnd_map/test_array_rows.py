"""Numbering rows: as numpy does along an axis, whatever the range of the numbers."""

import numpy as np
import pytest

from gnd.gnd_map.arrays import numbered_rows


@pytest.mark.parametrize("largest", [1, 5, 10**6, 2**62])
@pytest.mark.parametrize("n", [0, 1, 400])
def test_rows_are_numbered_as_by_numpy(largest: int, n: int) -> None:
    rows = np.random.default_rng(n).integers(-largest, largest, (n, 3))
    plain = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    np.testing.assert_array_equal(numbered_rows(rows), plain)
