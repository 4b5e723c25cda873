"""What a single vehicle's reports alone would make of the map."""

import numpy as np
from change_testing import at, change

from gnd.deploy.evaluation import with_statement
from gnd.gnd_map.gaussian import Gaussians, concat

NOTHING = Gaussians.empty()


def test_changed_voxels_are_as_said_and_the_rest_stays() -> None:
    said = concat([Gaussians.nothing_at(np.array([2], np.int32)), at([3], up_m=0.3)])
    after = with_statement(at([1, 2, 3]), at([1, 2, 3]), change([1, 2, 3, 4], said), NOTHING)
    assert after == concat([at([1]), at([3], up_m=0.3)])


def test_a_voxel_seen_unchanged_is_as_in_the_version_that_was_held() -> None:
    held = at([1, 5], up_m=0.1)
    after = with_statement(at([1, 2, 3]), held, change([1, 3, 5], Gaussians.empty()), NOTHING)
    assert after == concat([at([1], up_m=0.1), at([2]), at([5], up_m=0.1)])


def test_nothing_where_nothing_was_changes_nothing() -> None:
    said = Gaussians.nothing_at(np.array([9], np.int32))
    assert with_statement(at([1]), at([1]), change([9], said), NOTHING) == at([1])


def test_a_gaussian_that_was_not_asked_for_is_that_of_the_final_map() -> None:
    said, final = Gaussians.nothing_at(np.array([2, 9], np.int32)), at([1, 2, 7], up_m=0.2)
    after = with_statement(at([1, 2]), at([1, 2]), change([1, 2, 9], said, withheld=True), final)
    assert after == concat([at([1]), at([2], up_m=0.2)])
