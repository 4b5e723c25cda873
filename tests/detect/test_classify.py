"""From counters to classes, voxel by voxel, and to what is reported."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_scene import FIGURE_2

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import TileChange
from gnd.vehicle_agent.detect.classify import Classification, classify, tile_change
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty

PLANE = (0.0008, 0.0, 0.0, 0.08, 0.0, 0.08)  # upright, facing x
FIRST_VOXEL = 36_000


def gaussians(ids: list[int], counts: list[int], cells: list[int], x: list[float]) -> Gaussians:
    n, exists = len(ids), np.array(counts) > 0
    mean = np.where(exists[:, None], np.column_stack([x, np.zeros(n), np.zeros(n)]), 0.0)
    cov = np.where(exists[:, None], np.tile(PLANE, (n, 1)), 0.0)
    columns = (np.array(c, np.int32) for c in (ids, counts, cells))
    return Gaussians(*columns, mean.astype(np.float32), cov.astype(np.float32))


def one(
    *, in_map: bool, bi: int = 0, bo: int = 0, pi: int = 0, po: int = 0, be: int = 0, pe: int = 0,
    cells: int = 0, x_m: float = 0.0, map_cells: int = 60,
) -> TileEvidence:  # fmt: skip
    """Evidence about one voxel; the map's plane stands at x = 0, the measured points at `x_m` with `cells`."""
    base = gaussians([FIRST_VOXEL], [200], [map_cells], [0.0]) if in_map else Gaussians.empty()
    count = max(bi + bo + be, cells)
    numbers = {name: np.array([n], np.int32) for name, n in zip(
        ("n_bi", "n_bo", "n_pi", "n_po", "n_be", "n_pe"), (bi, bo, pi, po, be, pe), strict=True)}  # fmt: skip
    return TileEvidence(
        base=Tile(FIGURE_2[0], 3 if in_map else 0, base),
        voxel_id=np.array([FIRST_VOXEL], np.int32),
        map_row=np.array([0 if in_map else -1], np.int64),
        measured=gaussians([FIRST_VOXEL], [count], [cells], [x_m]),
        **numbers,
    )


def said(e: TileEvidence, p: DetectParameters) -> str:
    return ChangeClass(int(classify(e, p).change_class[0])).name


CASES = [
    # what rays saw, in default mode, in paper mode
    (one(in_map=True, bi=100, cells=50), "NORMAL", "NORMAL"),
    (one(in_map=True, bi=5), "NORMAL", "NORMAL"),
    (one(in_map=True, bi=100, bo=20, cells=50, x_m=0.01), "NORMAL", "NORMAL"),
    (one(in_map=True, bi=10, bo=200, cells=50, x_m=0.4), "MODIFIED", "MODIFIED"),
    (one(in_map=True, bi=10, bo=200, cells=50, x_m=0.02), "NORMAL", "MODIFIED"),  # alike: only noise was outside
    (one(in_map=True, bi=100, bo=40, cells=50, x_m=0.4), "MODIFIED", "NORMAL"),  # sustained, but of another shape
    (
        one(in_map=True, bi=100, bo=40, cells=21, x_m=0.4, map_cells=120),
        "MODIFIED",
        "NORMAL",
    ),  # little, but far off
    (one(in_map=True, pi=100), "DELETED", "DELETED"),
    (one(in_map=True, pi=2), "UNMEASURED", "UNMEASURED"),
    (one(in_map=True, pi=100, bo=2, cells=2), "DELETED", "UNMEASURED"),
    (one(in_map=True, pi=500, bo=9, cells=9), "UNMEASURED", "UNMEASURED"),  # weak hits abstain
    (one(in_map=True, bi=100, pi=50, cells=50), "NORMAL", "NORMAL"),
    (one(in_map=True, po=1000), "UNMEASURED", "UNMEASURED"),  # passing outside says nothing
    (one(in_map=True, bo=30, cells=12), "UNMEASURED", "UNMEASURED"),
    (one(in_map=False, be=200, cells=50), "NEW", "NEW"),
    (one(in_map=False, be=200, cells=50, pe=5000), "NEW", "NEW"),
    (one(in_map=False, pe=50), "EMPTY", "EMPTY"),
    (one(in_map=False, pe=2), "UNMEASURED", "EMPTY"),
    (one(in_map=False, be=15, cells=12, pe=60), "UNMEASURED", "UNMEASURED"),  # weak hits abstain
    (one(in_map=False, be=15, cells=12, pe=5000), "EMPTY", "UNMEASURED"),  # unless many rays looked
    (one(in_map=False, be=3, cells=3, pe=5000), "EMPTY", "UNMEASURED"),
]


@pytest.mark.parametrize(("evidence", "default", "paper"), CASES)
def test_the_class_follows_from_the_counters(evidence: TileEvidence, default: str, paper: str) -> None:
    assert said(evidence, DetectParameters()) == default
    assert said(evidence, DetectParameters.paper()) == paper


def test_a_part_of_what_the_map_holds_is_no_other_shape_where_rays_lay_at_one_height() -> None:
    """Points outside of the map's Gaussian decide: more than the 5 % that Eq. (1) leaves outside of what stands."""
    p = DetectParameters()
    for outside, level, many in ((0, "NORMAL", "MODIFIED"), (5, "NORMAL", "MODIFIED"), (40, "MODIFIED", "MODIFIED")):
        e = one(in_map=True, bi=100, bo=outside, pi=60, cells=50, x_m=0.4)
        assert said(replace(e, at_one_height=True), p) == level
        assert said(e, p) == many


def test_deletion_needs_more_rays_that_passed_than_chance_explains() -> None:
    """A plane stops at least a quarter of the rays through it, by the least that a Gaussian is taken to stop."""
    p = DetectParameters()
    assert said(one(in_map=True, bo=100, cells=0), p) == "UNMEASURED"
    assert said(one(in_map=True, pi=13), p) == "UNMEASURED"
    assert said(one(in_map=True, pi=14), p) == "DELETED"
    assert said(one(in_map=True, pi=30, bo=4, cells=4), p) == "UNMEASURED"  # 4 hits of 34: as through a fence
    assert said(one(in_map=True, pi=60, bo=4, cells=4), p) == "DELETED"


def test_a_new_gaussian_must_be_more_than_a_matter_of_sampling() -> None:
    """24 sub-cells of 200 points are all that there is; of 24 points they may be any number."""
    p = DetectParameters()
    assert said(one(in_map=False, be=200, cells=24), p) == "NEW"
    assert said(one(in_map=False, be=24, cells=24, pe=200), p) != "NEW"
    assert said(one(in_map=False, be=36, cells=36), p) == "NEW"
    assert said(one(in_map=False, be=35, cells=35), p) != "NEW"
    assert said(one(in_map=False, be=2000, cells=19), p) != "NEW"  # no Gaussian at all


def several() -> tuple[TileEvidence, Classification]:
    ids = [FIRST_VOXEL + k for k in range(5)]  # normal, deleted, modified, new, abstaining
    base = gaussians(ids[:3], [200] * 3, [60] * 3, [0.0] * 3)
    columns = {
        "n_bi": [100, 0, 5, 0, 0], "n_bo": [0, 2, 200, 0, 0], "n_pi": [0, 60, 0, 0, 0], "n_po": [0] * 5,
        "n_be": [0, 0, 0, 90, 9], "n_pe": [0, 0, 0, 7, 7],
    }  # fmt: skip
    evidence = TileEvidence(
        base=Tile(FIGURE_2[0], 3, base),
        voxel_id=np.array(ids, np.int32),
        map_row=np.array([0, 1, 2, -1, -1], np.int64),
        measured=gaussians(ids, [100, 2, 205, 90, 9], [50, 2, 50, 50, 9], [0.0, 0.4, 0.4, 0.1, 0.1]),
        pose=PoseUncertainty(0.03, 0.001, range_m=17.0),
        **{name: np.array(column, np.int32) for name, column in columns.items()},
    )
    return evidence, classify(evidence, DetectParameters())


def test_the_report_names_what_was_observed_and_what_changed() -> None:
    evidence, found = several()
    change = tile_change(found)
    assert isinstance(change, TileChange)
    assert (change.base_version, change.base_sha) == (3, evidence.base.sha)
    np.testing.assert_array_equal(change.observed, evidence.voxel_id[:4])  # who abstains has not observed
    np.testing.assert_array_equal(change.changed.voxel_id, evidence.voxel_id[1:4])
    assert [ChangeClass(c).name for c in change.change_class] == ["DELETED", "MODIFIED", "NEW"]
    np.testing.assert_array_equal(change.changed.count, [0, 205, 90])  # nothing is left of the deleted
    np.testing.assert_array_equal(change.changed.cells, [0, 50, 50])
    np.testing.assert_array_equal(change.evidence, [[0, 2, 0, 60], [5, 200, 0, 0], [0, 0, 90, 0]])
    assert (change.pose_sigma_m, change.pose_sigma_rad) == (0.03, 0.001)


def test_without_a_map_the_report_has_no_base() -> None:
    found = classify(one(in_map=False, be=200, cells=50), DetectParameters())
    change = tile_change(found)
    assert (change.base_version, change.base_sha) == (0, b"")
    assert len(change.changed) == 1
