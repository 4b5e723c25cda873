"""Parts of surveys as bytes: the same after the journey, and refused by name where they cannot be true."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from survey_street import START_NS, TILE, Driven, key_of_part, survey_of_drive

from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.survey.inbox import SurveyInbox, check_survey
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, SchemaError
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.keys import change_key
from gnd.schemas.packed import decode_upload
from gnd.schemas.survey import SurveyAnchor, SurveyMotion, SurveyReport
from gnd.schemas.upload_head import head_of_upload
from gnd.tile_store.sqlite_store import SqliteStore


@lru_cache
def part() -> SurveyReport:
    (one,) = survey_of_drive(Driven("car-1", submaps=3))
    return one


def test_a_part_comes_out_as_it_went_in() -> None:
    body = part().encode()
    back = decode_upload(body)
    assert isinstance(back, SurveyReport)
    assert (back.report_id, back.part, back.is_last, back.vehicle) == (part().report_id, 0, True, "car-1")
    for before, after in zip(part().submaps, back.submaps, strict=True):
        assert (before.number, before.t_ns, dict(before.bodies)) == (after.number, after.t_ns, dict(after.bodies))
        if before.step is not None and after.step is not None:
            np.testing.assert_allclose(after.step.T, before.step.T, atol=1e-12)
            np.testing.assert_allclose(after.step.covariance, before.step.covariance, rtol=1e-6)
    assert back.anchors[0].tile == part().anchors[0].tile
    np.testing.assert_allclose(back.anchors[0].pose.T, part().anchors[0].pose.T, atol=1e-9)
    assert back.fixes[1].lat_rad == part().fixes[1].lat_rad
    head = head_of_upload(body)
    assert (head.form, head.report_id, head.place) == ("whole", part().report_id, ("ndt", part().district))


def test_every_truncation_and_bit_flip_is_refused_or_understood() -> None:
    body = part().encode()
    for length in range(0, len(body), 997):
        with pytest.raises(SchemaError):
            decode_upload(body[:length])
    rng = np.random.default_rng(1)
    for _ in range(60):
        broken = bytearray(body)
        broken[rng.integers(len(body))] ^= 1 << int(rng.integers(8))
        try:
            back = decode_upload(bytes(broken))
            if isinstance(back, SurveyReport):
                check_survey(key_of_part(part()), back)
        except (SchemaError, BadReport):
            pass


def test_more_bytes_than_a_part_may_have_are_refused_before_they_are_parsed() -> None:
    number = change_report_pb2.ChangeReport.DESCRIPTOR.fields_by_name["survey"].number
    padding = b"\x7a\x80\x80\x40" + bytes(limits.MAX_SURVEY_REPORT_BYTES)  # field 15, one MiB
    assert padding[0] == number << 3 | 2
    for read in (decode_upload, head_of_upload, SurveyReport.decode):
        with pytest.raises(SchemaError, match=f"bytes, the limit is {limits.MAX_SURVEY_REPORT_BYTES}"):
            read(b"\x08\x01" + padding)


def test_many_empty_submaps_are_counted_before_they_are_parsed() -> None:
    number = change_report_pb2.ChangeReport.DESCRIPTOR.fields_by_name["survey"].number
    inside = b"\x62\x00" * 5000  # field 12, empty
    size = bytes([len(inside) & 0x7F | 0x80, len(inside) >> 7])
    bomb = b"\x08\x01" + bytes([number << 3 | 2]) + size + inside
    for read in (decode_upload, head_of_upload, SurveyReport.decode):
        with pytest.raises(SchemaError, match="SurveyReport of 10000 bytes has more than"):
            read(bomb)


def test_values_that_cannot_be_are_refused() -> None:
    one, step = part().submaps[1], part().submaps[1].step
    assert step is not None
    far = step.T.copy()
    far[0, 3] = 400.0
    with pytest.raises(BadValue, match=r"lies 400\.0 m from the one before, the limit is 100 m"):
        replace(one, step=replace(step, T=far))
    with pytest.raises(BadValue, match="positive definite"):
        replace(step, covariance=np.zeros((6, 6)))
    with pytest.raises(BadValue, match="it has 0 to 2"):
        replace(part(), fixes=(replace(part().fixes[0], submap=7),))
    with pytest.raises(BadValue, match=r"has submaps \[0, 2\]"):
        replace(part(), submaps=part().submaps[::2], fixes=(), anchors=())
    with pytest.raises(BadValue, match="no submaps"):
        replace(part(), submaps=(), fixes=(), anchors=())
    with pytest.raises(BadValue, match="holds features"):
        replace(part(), layer="signs")


def test_forged_places_are_refused_with_numbers() -> None:
    anchor = part().anchors[0]
    elsewhere = TileId.from_geodetic(np.radians(40.0), np.radians(9.2))
    forged = replace(part(), anchors=(SurveyAnchor(0, elsewhere, anchor.pose),))
    with pytest.raises(BadReport, match=r"the anchor of submap 0 lies \d+ km from the district, the limit is 20 km"):
        check_survey(key_of_part(part()), forged)
    beside = anchor.pose.T.copy()
    beside[:2, 3] += 900.0
    forged = replace(part(), anchors=(SurveyAnchor(0, TILE, SurveyMotion(beside, anchor.pose.covariance)),))
    with pytest.raises(BadReport, match=r"lies 127\d m from its fix, the limit is 112 m"):
        check_survey(key_of_part(part()), forged)
    with pytest.raises(BadReport, match="came on the key of"):
        check_survey(change_key("ndt", elsewhere.district), part())
    hurried = replace(part().submaps[1], t_ns=part().submaps[0].t_ns + 1000)
    with pytest.raises(BadReport, match=r"from submap 0 to 1 20\.0 m in 0\.00 s"):
        check_survey(key_of_part(part()), replace(part(), submaps=(part().submaps[0], hurried), fixes=(), anchors=()))


def test_a_survey_belongs_to_one_vehicle_and_a_part_comes_once(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "store.sqlite") as store:
        inbox, key = SurveyInbox(store), key_of_part(part())
        inbox.keep(key, part(), START_NS)
        inbox.keep(key, part(), START_NS + 1)
        with pytest.raises(BadReport, match="is of car-1 in layer ndt, part 0 of thief"):
            inbox.keep(key, replace(part(), vehicle="thief"), START_NS)


def test_what_is_acknowledged_is_kept_and_nonsense_is_set_aside(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "store.sqlite") as store:
        ingest, body = Ingest(store, "m1", now_ns=lambda: START_NS + 10**12), part().encode()
        assert ingest.answer(key_of_part(part()), body).status == "stored"
        assert ingest.answer(key_of_part(part()), body).status == "duplicate"
        assert ingest.answer(key_of_part(part()), body[:-9]).status == "quarantined"
        ahead = Ingest(store, "m1", now_ns=lambda: START_NS - 10**13).answer(key_of_part(part()), body)
        assert ahead.status == "quarantined"
        assert "after it was received" in ahead.reason
        (claim,) = store.claim_uploads("m1", 8, 10.0)
        assert claim.upload.body == body
