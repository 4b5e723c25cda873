"""Results found again by the values of arrays; what a tile's groups and its map were judged by stays as it was."""

import numpy as np

from gnd.gnd_map.by_content import ByContent


def test_equal_values_are_found_again_and_others_are_not():
    made, kept = [], ByContent(2)

    def of(*arrays):
        return kept.of(arrays, lambda: made.append(arrays) or len(made))

    one, two = np.arange(6.0), np.arange(6.0)[::-1]
    assert of(one, two) == of(one.copy(), two.copy()) == 1  # the second one is not contiguous
    assert of(two, one) == 2
    assert of(one.reshape(2, 3), two) == 3  # the same bytes in another shape
    assert of(one, two) == 4  # only two are kept
    assert of(np.array([0.0]), two) != of(np.array([-0.0]), two)  # equal, but not to the bit
