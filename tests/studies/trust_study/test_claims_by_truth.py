"""Claims are counted by what the truth says of their voxels."""

import numpy as np

from gnd.fleet_sim.dense_scan import ScanPlan
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import TileChange
from studies.trust_study.claims import counted

TILE = TileId(497353963152)
PLANE, BUSH = (0.0004, 0.0, 0.0, 0.08, 0.0, 0.08), (0.02, 0.0, 0.0, 0.03, 0.0, 0.07)
NEW, MODIFIED, DELETED = ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED


def gaussians(covs: dict[int, tuple[float, ...]]) -> Gaussians:
    n = len(covs)
    full = np.full(n, 60, np.int32)
    return Gaussians(np.int32(list(covs)), full, full, np.zeros((n, 3), np.float32), np.float32(list(covs.values())))


def truth(classes: dict[int, ChangeClass]) -> Truth:
    n = len(classes)
    yes = np.ones(n, np.bool_)
    ids, said = np.int32(list(classes)), np.uint8(list(classes.values()))
    tiles, frame = np.full(n, TILE.morton, np.int64), LocalFrame.of_tile(TILE)
    return Truth("", ScanPlan(), frame, tiles, ids, said, yes, yes, ~yes, {}, {})


def test_each_claim_is_counted_by_its_truth_its_points_and_its_gaussian() -> None:
    was = gaussians({11: PLANE, 12: PLANE, 13: PLANE, 21: PLANE, 22: BUSH, 23: BUSH})
    true = truth({1: NEW, 11: MODIFIED, 12: ChangeClass.NORMAL, 13: MODIFIED, 21: DELETED, 22: DELETED})
    claims = {  # class, points inside and outside of the map's Gaussian
        1: (NEW, 0, 0), 2: (NEW, 0, 0), 11: (MODIFIED, 10, 90), 12: (MODIFIED, 100, 0), 13: (MODIFIED, 95, 5),
        21: (DELETED, 0, 0), 22: (DELETED, 0, 0), 23: (DELETED, 0, 0),
    }  # fmt: skip
    ids = np.int32(list(claims))
    change = TileChange(
        tile=TILE,
        base_version=1,
        base_sha=bytes(32),
        observed=ids,
        changed=Gaussians.nothing_at(ids),
        change_class=np.uint8([said for said, _, _ in claims.values()]),
        evidence=np.int32([[inside, outside, 0, 50] for _, inside, outside in claims.values()]),
        pose_sigma_m=0.01,
        pose_sigma_rad=0.001,
    )
    assert counted(change, true, was) == {
        "claims": 8, "wrong": 3, "new, wrong": 1, "modified, wrong": 1, "of it inside": 1, "inside, right": 1,
        "deleted, wrong": 1, "of it no plane": 1, "no plane, right": 1,
    }  # fmt: skip
