"""Doubts about tiles: what cannot be is refused, what a newer program says is kept."""

from typing import Any

import pytest
from schema_values import EAST, GOLDEN, MUCH, NOTHING, SHIFTED, change, report

from gnd.schemas.changes import ChangeReport, split
from gnd.schemas.doubt import Doubt, DoubtReason, doubt_message, doubt_value
from gnd.schemas.errors import BadValue, SchemaError
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.packed import decode_upload


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"reasons": DoubtReason.NONE}, "doubt without a reason"),
        ({"withheld": -1}, "withheld -1 is outside"),
        ({"explained_permille": 1001}, "explained_permille 1001 is outside 0 .. 1000"),
        ({"changed_permille": -1}, "changed_permille -1 is outside"),
        ({"left_mm": 100_001}, "left_mm 100001 is outside -100000 .. 100000"),
        ({"turn_10urad": -314_161}, "turn_10urad -314161"),
    ],
)
def test_doubts_that_cannot_be_are_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(BadValue, match=reason):
        Doubt(**({"reasons": DoubtReason.POSE_NOT_CHECKED} | values))


def test_a_reason_of_a_newer_version_is_a_doubt_all_the_same() -> None:
    newer = Doubt(DoubtReason(2**20 | 2))
    assert doubt_value(doubt_message(newer)) == newer
    assert newer.words == ("implausible_share",)


def test_figures_come_out_in_metres_and_radians() -> None:
    assert SHIFTED.shift_m == pytest.approx((-0.031, 0.204, -0.007))
    assert SHIFTED.turn_rad == pytest.approx(-0.00873)
    assert (SHIFTED.explained_share, MUCH.changed_share) == (0.873, 0.655)
    assert SHIFTED.words == ("explained_by_shift", "health_not_good")


def test_a_tile_that_holds_changes_back_names_no_voxel() -> None:
    assert change(doubt=SHIFTED, **NOTHING).doubt == SHIFTED
    with pytest.raises(BadValue, match="314 changes are held back, and 538 voxels are named"):
        change(doubt=SHIFTED)


def test_every_tile_keeps_its_own_doubt_when_a_report_is_split() -> None:
    whole = report(tiles=(change(), change(EAST, doubt=MUCH)))
    assert [ChangeReport.decode(body).tiles[0].doubt for _, body in split(whole)] == [None, MUCH]


def test_bytes_of_doubts_that_cannot_be_are_refused() -> None:
    message = change_report_pb2.ChangeReport.FromString(report(tiles=(change(doubt=MUCH),)).encode())
    message.tiles[0].doubt.reasons = 0
    with pytest.raises(BadValue, match="doubt without a reason"):
        ChangeReport.decode(message.SerializeToString())
    message = change_report_pb2.ChangeReport.FromString(GOLDEN["PackedReport-doubtful"].encode())
    message.packed.doubtful.append(1024)
    with pytest.raises(SchemaError, match="3 doubtful tiles and 2 doubts"):
        decode_upload(message.SerializeToString())
