"""What is remembered of a report that was written here is what its bytes say, to the bit."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import GROUND, TILE, change_of, gaussians_of, report_of
from test_merge_purity import changes

from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.stored import encoded_parts, report_of_row, reports_by_window, said
from gnd.schemas.changes import ChangeReport, split
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.tile_store.values import ReportRow


@settings(max_examples=60, deadline=None)
@given(changes(), st.integers(0, 1 << 40), st.booleans(), st.sampled_from([0.1, 1 / 3, 0.0317]))
def test_a_remembered_report_is_what_its_bytes_say(change, number, doubts, sigma):
    doubt = Doubt(DoubtReason.EXPLAINED_BY_SHIFT, forward_mm=-17, turn_10urad=3) if doubts else None
    report = report_of(number, replace(change, pose_sigma_m=sigma, doubt=doubt))
    assert encoded_parts(report) == split(report)
    for (_, body), one in zip(encoded_parts(report), report.tiles, strict=True):
        kept, read = said(body), ChangeReport.decode(body)
        assert kept == read
        assert kept.tiles[0].changed is one.changed  # it was not decoded
        for mine, decoded in zip(kept.tiles[0].changed.columns, read.tiles[0].changed.columns, strict=True):
            assert mine.tobytes() == decoded.tobytes()
        np.testing.assert_array_equal(kept.tiles[0].observed, read.tiles[0].observed)


def test_a_row_that_cannot_be_read_is_told_each_time_and_left_out():
    rules, told = MergeParameters(), []
    (good,) = encoded_parts(report_of(1, change_of(gaussians_of({0: GROUND}), [0, 1], {1: GROUND})))
    rows = [
        ReportRow(f"{n:026d}", "ndt", TILE, "v", 5, body, window=1, seq=n) for n, body in enumerate((good[1], b"?"), 1)
    ]
    for _ in range(2):
        found = reports_by_window(rows, lambda _window: rules, lambda row, _: told.append(row.seq))
        assert [len(reports) for reports in found.values()] == [1]
    assert told == [2, 2]
    assert report_of_row(rows[0], rules) is report_of_row(rows[0], rules)
    assert report_of_row(rows[0], MergeParameters(poses=False)) is not report_of_row(rows[0], rules)
