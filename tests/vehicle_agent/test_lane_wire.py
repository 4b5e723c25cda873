"""Pieces of lanes on the wire: whatever a drive finds comes back as it was rounded, and torn bytes are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lane_road import FRAME, drive, report_of

from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.features.check import check_feature_report
from gnd.gnd_map.features import hit, six_of
from gnd.gnd_map.features.lane_pieces import beside, lane_pieces
from gnd.schemas.errors import SchemaError
from gnd.schemas.feature_change import FeatureChange, Found
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS

PIECES = st.tuples(
    st.floats(-3.1, 3.1), st.floats(-60.0, 60.0), st.floats(0.012, 0.5), st.sampled_from(["solid", "dashed"]),
    st.sampled_from(["white", "yellow"]), st.integers(1, 500),
)  # fmt: skip


def _found(heading, left, sigma, marking, colour, hits):
    s = np.arange(-12.0, 12.0, 2.0)
    t, n = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    line = np.column_stack([s[:, None] * t + left * n, np.zeros(len(s))])
    told = (("color", colour), ("subtype", marking))
    cov = six_of(np.diag([1.0, sigma**2, 0.02]))
    pieces = lane_pieces(*FRAME.geodetic_from_enu(line))
    return [(one.tile, Found("lane_marking", one.points_m, cov, hit(0.9), hits, told)) for one in pieces]


@settings(max_examples=50, deadline=None)
@given(rows=st.lists(PIECES, min_size=1, max_size=4, unique_by=lambda row: round(row[1])))
def test_what_a_drive_finds_comes_back(rows):
    by_tile: dict = {}
    for row in rows:
        for tile, found in _found(*row):
            by_tile.setdefault(tile, []).append(found)
    changes = [FeatureChange(tile, 0, b"", 0, (), tuple(some)) for tile, some in sorted(by_tile.items())]
    for report in report_of(changes, 0):
        assert FeatureReport.decode(report.encode()) == report
        check_feature_report(report, lambda _tile, _sha: None, MARKINGS)
        for change in report.tiles:
            for sent, came in zip(by_tile[change.tile], change.found, strict=True):
                _, off_m = beside(sent.points_m, came.points_m)
                assert abs(off_m) < 1.5e-3
                assert (came.attributes, came.hits) == (sent.attributes, sent.hits)


def test_torn_bytes_are_refused():
    (report,) = report_of(drive().leave_all(), 0)[:1]
    body = report.encode()
    for end in range(1, len(body), max(1, len(body) // 60)):
        with pytest.raises(SchemaError):
            FeatureReport.decode(body[:end])


def test_another_kind_and_a_point_are_no_piece():
    report = report_of(drive().leave_all(), 0)[0]
    tile = next(change for change in report.tiles if change.found)
    for wrong in (
        Found("guard_rail", tile.found[0].points_m, tile.found[0].cov_m2, hit(0.9)),
        Found("lane_marking", tile.found[0].points_m[:1], tile.found[0].cov_m2, hit(0.9)),
    ):
        bad = report_of([FeatureChange(tile.tile, 0, b"", 0, (), (wrong,))], 0)[0]
        with pytest.raises(BadReport):
            check_feature_report(bad, lambda _tile, _sha: None, MARKINGS)
