"""Reports in two halves on the wire: round trips of any value, and refusals that say what is wrong."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_values import GOLDEN, MUCH, REPORT_ID, SHA, SHIFTED, TILE, any_doubt, names, report, texts

from gnd.gnd_map.codec import encode_mask, encode_tiles
from gnd.schemas import limits
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.course import Course
from gnd.schemas.errors import BadValue, Malformed, SchemaError, TooLarge, WrongVersion
from gnd.schemas.generated import change_ack_pb2, change_report_pb2, report_state_pb2
from gnd.schemas.packed import PackedGaussians, PackedReport, crc_of, decode_upload, digest_of
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState, state_message


def packed(**values: Any) -> PackedReport:
    return dataclasses.replace(GOLDEN["PackedReport-three_tiles"], **values)


HALF: PackedGaussians = GOLDEN["PackedGaussians-some"]


def as_message(value: PackedReport | PackedGaussians) -> change_report_pb2.ChangeReport:
    return change_report_pb2.ChangeReport.FromString(value.encode())


@st.composite
def any_packed(draw: Any) -> PackedReport:
    indices = sorted(draw(st.frozensets(st.integers(0, 1023), min_size=1, max_size=40)))
    first_ns = draw(st.integers(0, 2**63 - 1))
    doubtful = sorted(draw(st.frozensets(st.sampled_from(indices), max_size=4)))
    return PackedReport(
        report_id=deterministic_report_id(draw(st.integers(0, 2**48 - 1)), draw(texts)),
        vehicle=draw(names),
        sensor_model=draw(texts),
        software=draw(texts),
        first_ns=first_ns,
        length_ns=draw(st.integers(0, 2**63 - 1 - first_ns)),
        tiles=tuple((index, draw(st.integers(0, 2**31 - 1))) for index in indices),
        base_digest=draw(st.binary(min_size=8, max_size=8)),
        flags=draw(st.binary(max_size=60)),
        track=draw(st.binary(max_size=60)),
        pose_sigma_tenth_mm=draw(st.integers(0, 2**32 - 1)),
        pose_sigma_10urad=draw(st.integers(0, 2**32 - 1)),
        doubts=tuple((index, draw(any_doubt())) for index in doubtful),
        course=draw(st.none() | st.builds(Course, st.integers(-314_160, 314_160), st.integers(1, 314_160))),
        **draw(st.sampled_from([{}, {"unsure": b"voxels", "unsure_measured": b"what was met"}])),
        measured=draw(st.binary(max_size=60)),
        is_patient=draw(st.booleans()),
    )


@given(any_packed())
@settings(max_examples=80)
def test_any_first_half_survives(value: PackedReport) -> None:
    assert decode_upload(value.encode()) == value
    assert PackedReport.decode(value.encode()) == value


@given(st.binary(max_size=400), st.integers(0, 2**32 - 1))
def test_any_second_half_survives(measured: bytes, crc: int) -> None:
    value = PackedGaussians(REPORT_ID, measured, crc)
    assert decode_upload(value.encode()) == value
    assert PackedGaussians.decode(value.encode()) == value


def test_one_key_takes_all_three_forms() -> None:
    whole = report()
    assert [decode_upload(value.encode()) for value in (whole, packed(), HALF)] == [whole, packed(), HALF]


def test_a_reader_of_one_form_names_the_form_that_came() -> None:
    with pytest.raises(BadValue, match="no first half of a report but a PackedGaussians"):
        PackedReport.decode(HALF.encode())
    with pytest.raises(BadValue, match="no second half of a report but a ChangeReport"):
        PackedGaussians.decode(report().encode())
    for value in (packed(), HALF):
        with pytest.raises(BadValue, match="only a whole report is read"):
            ChangeReport.decode(value.encode())


@pytest.mark.parametrize("field", ["report_id", "vehicle", "layer", "district"])
def test_two_forms_in_one_message_are_refused(field: str) -> None:
    message = as_message(packed())
    setattr(message, field, getattr(change_report_pb2.ChangeReport.FromString(report().encode()), field))
    with pytest.raises(BadValue, match=f"packed and also {field}"):
        decode_upload(message.SerializeToString())
    both = as_message(packed())
    both.gaussians.CopyFrom(as_message(HALF).gaussians)
    with pytest.raises(BadValue, match="packed and also gaussians"):
        decode_upload(both.SerializeToString())


def test_another_major_version_is_refused() -> None:
    message = as_message(packed())
    message.major = 2
    with pytest.raises(WrongVersion, match="major version 2"):
        decode_upload(message.SerializeToString())


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"tiles": ()}, "has no tiles"),
        ({"tiles": ((3, 1), (3, 2))}, "not strictly ascending"),
        ({"tiles": ((4, 1), (3, 2))}, "not strictly ascending"),
        ({"tiles": ((1024, 1),)}, "index of a tile 1024"),
        ({"tiles": ((3, 2**32),)}, "base version 4294967296"),
        ({"base_digest": b"1234567"}, "7 bytes, expected 8"),
        ({"report_id": "not a ulid"}, "report id"),
        ({"vehicle": "with/slash"}, "vehicle"),
        ({"first_ns": 2**63 - 1, "length_ns": 1}, "last_ns"),
        ({"pose_sigma_tenth_mm": 2**32}, "pose_sigma_tenth_mm"),
        ({"pose_sigma_10urad": -1}, "pose_sigma_10urad"),
        ({"unsure": b"some"}, "4 bytes of unsure voxels and 0 of what was met there"),
        ({"unsure_measured": b"of none"}, "0 bytes of unsure voxels and 7 of what was met there"),
        ({"doubts": ((1, MUCH),)}, "1 doubtful tiles are not strictly ascending among its 3"),
        ({"doubts": ((17, MUCH), (0, MUCH))}, "2 doubtful tiles are not strictly ascending"),
        ({"doubts": ((17, SHIFTED),)}, "holds back 314 changes: only a whole report can"),
    ],
)
def test_first_halves_that_cannot_be_are_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(SchemaError, match=reason):
        packed(**values)


def test_bytes_of_a_first_half_that_cannot_be_are_refused() -> None:
    for name, value, reason in (
        ("report_id", b"short", "5 bytes, expected 16"),
        ("tiles", b"", "tiles of PackedReport"),
        ("tiles", encode_tiles([(1, 1)])[:-1], "tiles of PackedReport"),
        ("base_digest", b"", "0 bytes, expected 8"),
        ("vehicle", "", "vehicle"),
    ):
        message = as_message(packed())
        setattr(message.packed, name, value)
        with pytest.raises(SchemaError, match=reason):
            decode_upload(message.SerializeToString())


def test_every_truncation_is_refused() -> None:
    for value in (packed(), HALF):
        data = value.encode()
        for end in range(3, len(data)):
            with pytest.raises(Malformed):
                decode_upload(data[:end])


def test_sizes_are_limited_on_both_sides() -> None:
    with pytest.raises(TooLarge, match="limit of 1048576"):
        packed(flags=bytes(limits.MAX_PACKED_REPORT_BYTES)).encode()
    with pytest.raises(TooLarge, match="limit of 4194304"):
        PackedGaussians(REPORT_ID, bytes(limits.MAX_PACKED_GAUSSIANS_BYTES), 0).encode()
    large = as_message(packed())
    large.packed.flags = bytes(limits.MAX_PACKED_REPORT_BYTES)
    with pytest.raises(TooLarge, match="PackedReport of"):
        decode_upload(large.SerializeToString())
    with pytest.raises(TooLarge, match="ChangeReport of"):
        decode_upload(bytes(limits.MAX_CHANGE_REPORT_BYTES + 1))


def test_an_ack_asks_if_and_only_if_it_says_for_what() -> None:
    mask = encode_mask(np.arange(1000) % 7 == 0)
    ack = ChangeAck(REPORT_ID, "wanted", wanted=mask)
    assert ChangeAck.decode(ack.encode()) == ack
    for status, wanted in (("wanted", b""), ("stored", mask), ("resend", mask)):
        with pytest.raises(BadValue, match="one asks for the other"):
            ChangeAck(REPORT_ID, status, wanted=wanted)  # type: ignore[arg-type]
    with pytest.raises(TooLarge, match="mask of ChangeAck"):
        ChangeAck(REPORT_ID, "wanted", wanted=bytes(limits.MAX_WANTED_BYTES + 1))
    with pytest.raises(BadValue, match="report id"):
        ChangeAck("", "resend")


def test_an_ack_tells_of_earlier_reports_and_of_no_more_than_a_vehicle_reads() -> None:
    told = tuple(
        ReportState(deterministic_report_id(1, "v", str(n)), "released") for n in range(limits.MAX_STATES_OF_ACK + 1)
    )
    ack = ChangeAck(REPORT_ID, "stored", told=told[:-1])
    assert ChangeAck.decode(ack.encode()) == ack
    assert (
        len(ChangeAck(REPORT_ID, "stored", told=told[:1]).encode()) - len(ChangeAck(REPORT_ID, "stored").encode()) == 22
    )
    with pytest.raises(TooLarge, match="17 states of reports"):
        ChangeAck(REPORT_ID, "stored", told=told)
    many = change_ack_pb2.ChangeAck.FromString(ack.encode())
    many.told.append(state_message(told[-1]))
    with pytest.raises(TooLarge, match="17 states of reports"):
        ChangeAck.decode(many.SerializeToString())
    many.told[0].status = report_state_pb2.ReportState.Status.STATUS_UNSPECIFIED
    del many.told[-1]
    with pytest.raises(BadValue, match="ReportState status"):
        ChangeAck.decode(many.SerializeToString())


def test_a_flagged_district_costs_less_than_a_hundred_bytes_beside_flags_and_track() -> None:
    bare = packed(flags=b"", track=b"", tiles=tuple((k, 1) for k in range(0, 1024, 8)))
    assert len(bare.encode()) < 60 + len(bare.vehicle + bare.sensor_model + bare.software) + 0.6 * len(bare.tiles)


def test_digests_tell_bases_and_their_order_apart() -> None:
    other = bytes(reversed(SHA))
    found = {digest_of(bases) for bases in ([SHA, other], [other, SHA], [SHA], [SHA, SHA], [])}
    assert len(found) == 5
    assert crc_of(b"mask") != crc_of(b"mask ")


def test_values_do_not_change() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        packed().vehicle = "other"  # type: ignore[misc]
    assert TILE.district.contains(TILE)
