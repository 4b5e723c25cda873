"""How far reports have come: round trips, bounds, and what is no such message."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.schemas import limits
from gnd.schemas.errors import BadValue, Malformed, SchemaError, WrongVersion
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates

IDS = [deterministic_report_id(1_570_838_400_000 + n, "car") for n in range(70)]


def any_state() -> st.SearchStrategy[ReportState]:
    plain = st.builds(
        ReportState,
        st.sampled_from(IDS),
        st.sampled_from(["unknown", "waiting", "released", "resend", "quarantined"]),
        reason=st.text("abc 7", max_size=40),
    )
    return plain | st.builds(
        ReportState, st.sampled_from(IDS), st.just("wanted"), wanted=st.binary(min_size=1, max_size=99)
    )


@given(st.lists(any_state(), min_size=1, max_size=64))
def test_states_come_back_as_they_were(states: list[ReportState]) -> None:
    value = ReportStates(tuple(states))
    assert ReportStates.decode(value.encode()) == value


@given(st.lists(st.sampled_from(IDS), min_size=1, max_size=64))
def test_questions_come_back_as_they_were(ids: list[str]) -> None:
    value = ReportQuestion(tuple(ids))
    assert ReportQuestion.decode(value.encode()) == value


def test_word_of_one_report_is_small() -> None:
    assert len(ReportStates((ReportState(IDS[0], "released"),)).encode()) <= 24
    assert len(ReportQuestion((IDS[0],)).encode()) <= 20


@given(st.binary(max_size=60))
def test_any_bytes_are_a_message_or_are_refused(data: bytes) -> None:
    for kind in (ReportStates, ReportQuestion):
        try:
            kind.decode(data)
        except SchemaError:
            continue


@pytest.mark.parametrize("count", [0, 65])
def test_a_message_is_about_one_to_64_reports(count: int) -> None:
    with pytest.raises(BadValue, match="expected 1 to 64"):
        ReportQuestion(tuple(IDS[:count]))
    with pytest.raises(BadValue, match="expected 1 to 64"):
        ReportStates(tuple(ReportState(one, "waiting") for one in IDS[:count]))


@pytest.mark.parametrize(("status", "mask"), [("wanted", b""), ("released", b"mask")])
def test_a_mask_goes_with_what_is_wanted(status: str, mask: bytes) -> None:
    with pytest.raises(BadValue, match="one asks for the other"):
        ReportState(IDS[0], status, mask)  # type: ignore[arg-type]


def test_as_many_states_as_fit_are_told_and_always_one() -> None:
    large = [ReportState(one, "wanted", bytes(limits.MAX_WANTED_BYTES)) for one in IDS[:3]]
    assert ReportStates.fitting(large).states == (large[0],)
    small = [ReportState(one, "waiting") for one in IDS]
    fitting = ReportStates.fitting(small)
    assert fitting.states == tuple(small[:64])
    assert len(ReportStates.fitting([large[0], *small]).encode()) <= limits.MAX_REPORT_STATES_BYTES


def test_another_major_version_and_an_unknown_status_are_refused() -> None:
    good = ReportStates((ReportState(IDS[0], "released"),)).encode()
    with pytest.raises(WrongVersion):
        ReportStates.decode(b"\x08\x02" + good[2:])
    with pytest.raises(BadValue, match="ReportState status 9 is unknown"):
        ReportStates.decode(good[:-1] + b"\x09")
    with pytest.raises(Malformed):
        ReportStates.decode(good[:-1])
