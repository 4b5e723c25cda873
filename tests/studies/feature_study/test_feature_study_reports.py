"""From a study's drives to reports and back from merged tiles to the route's frame."""

from pathlib import Path

import numpy as np
import pytest

from gnd.cloud_merger.features import merge_layer
from gnd.gnd_map.features import Feature
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.features.layer import of_counts
from gnd.vehicle_agent.features.view import CAMERA
from studies.feature_study.reporting import (
    BaseLayer,
    Discovered,
    Judged,
    coverage_along,
    in_route_frame,
    read_reports,
    reports_of,
    write_reports,
)
from studies.frame.errors import FolderError
from studies.frame.kept import Kept

FRAME = LocalFrame(0.86, 0.045, 90.0)
KNOWN = np.array([[9000.0, 4.0], [9050.0, -4.0]])
NEW = np.array([9025.0, 5.0])
COV = np.array([[0.09, 0.02], [0.02, 0.04]])
BASE = BaseLayer.of(FRAME, np.array([7, 8]), ("warning", "exit"), KNOWN, 0.1)


def report(vehicle: str, offset_m: float = 0.0) -> list[FeatureReport]:
    """A drive eastwards that sees sign 7, misses sign 8 and finds a new one."""
    poses = np.column_stack([np.arange(8900.0, 9100.0, 2.0), np.zeros(100), np.zeros(100)])
    coverage = coverage_along(FRAME, CAMERA, poses, [None] * len(poses), 2.5)
    judged = [
        Judged(7, of_counts(20, 1, 0.9), 20, KNOWN[0] + offset_m, COV),
        Judged(8, of_counts(0, 20, 0.9), 0, None, None),
    ]
    found = [Discovered("warning", NEW + offset_m, COV, of_counts(15, 1, 0.9), 15)]
    return reports_of(BASE, "signs", vehicle, (10, 20), coverage, (judged, found))


def test_a_base_layer_comes_back_where_it_was_put() -> None:
    places = [in_route_frame(FRAME, tile, one.features) for tile, one in BASE.tiles.items()]
    xy_m = np.concatenate([xy for xy, _ in places])
    np.testing.assert_allclose(xy_m[xy_m[:, 0].argsort()], KNOWN, atol=1e-3)
    for _, cov in places:
        np.testing.assert_allclose(cov, np.broadcast_to(0.01 * np.eye(2), cov.shape), rtol=0.05, atol=2e-4)


def test_reports_are_one_a_district_and_survive_the_way(tmp_path: Path) -> None:
    sent, kept = report("car-1"), Kept(tmp_path, "reports", "k")
    assert len({one.district for one in sent}) == len(sent)
    write_reports(sent, kept)
    assert [one.snapped() for one in sent] == read_reports(kept)
    kept.path.write_bytes(b"PK")
    with pytest.raises(FolderError, match="delete it"):
        read_reports(kept)


def test_two_vehicles_change_the_layer_and_one_does_not() -> None:
    assert {one.feature_id for one in features(report("car-1"))} == {7, 8}
    both = merge_layer(BASE.epochs, [*report("car-1", 0.1), *report("car-2", -0.1)])
    new = [(tile, f) for tile, merged in both.items() for f in merged.features if f.feature_id not in BASE.tile_of]
    assert {f.feature_id for merged in both.values() for f in merged.features} & {7, 8} == {7}
    assert len(new) == 1
    xy_m, cov = in_route_frame(FRAME, new[0][0], [new[0][1]])
    np.testing.assert_allclose(xy_m[0], NEW, atol=2e-3)
    np.testing.assert_allclose(cov[0], COV / 2, rtol=0.05, atol=2e-4)


def features(reports: list[FeatureReport]) -> list[Feature]:
    """What the cloud publishes after these reports."""
    return [one for merged in merge_layer(BASE.epochs, reports).values() for one in merged.features]
