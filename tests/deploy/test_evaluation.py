"""What a single vehicle's reports alone would make of the map."""

import numpy as np

from deploy.evaluation import with_statement
from gnd_map.classes import ChangeClass
from gnd_map.gaussian import Gaussians, concat
from gnd_map.tile_id import TileId
from schemas.changes import TileChange

TILE = TileId(497353963154)
NOTHING = Gaussians.empty()


def at(voxel_ids: list[int], up_m: float = 0.0) -> Gaussians:
    n = len(voxel_ids)
    cov = np.tile(np.array([0.08, 0, 0, 0.08, 0, 0.0009], np.float32), (n, 1))
    mean = np.tile(np.array([0, 0, up_m], np.float32), (n, 1))
    count = np.full(n, 100, np.int32)
    return Gaussians(np.array(voxel_ids, np.int32), count, count, mean, cov)


def change(observed: list[int], changed: Gaussians, *, withheld: bool = False) -> TileChange:
    n = len(changed)
    return TileChange(
        tile=TILE,
        base_version=1,
        base_sha=b"\x01" * 32,
        observed=np.array(observed, np.int32),
        changed=changed,
        change_class=np.where(changed.exists | withheld, ChangeClass.MODIFIED, ChangeClass.DELETED).astype(np.uint8),
        evidence=np.zeros((n, 4), np.int32),
        pose_sigma_m=0.0,
        pose_sigma_rad=0.0,
    )


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
