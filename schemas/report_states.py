"""How far a vehicle's reports have come after their acks: what the merger tells, and what the vehicle asks."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import report_question_pb2, report_state_pb2, report_states_pb2
from gnd.schemas.report_id import bytes_of_report_id, check_report_id, report_id_of_bytes
from gnd.schemas.wire import (
    MAJOR,
    REASON_PATTERN,
    check_length,
    check_major,
    check_text,
    check_word,
    number_of,
    parse,
    serialise,
    word_of,
)

ReportStatus = Literal["unknown", "waiting", "wanted", "released", "resend", "quarantined"]
_STATUS: Final[dict[int, ReportStatus]] = {
    1: "unknown",
    2: "waiting",
    3: "wanted",
    4: "released",
    5: "resend",
    6: "quarantined",
}


@dataclass(frozen=True, slots=True)
class ReportState:
    """How far one report has come."""

    report_id: str
    status: ReportStatus
    wanted: bytes = b""
    """Status "wanted": of which new and modified voxels Gaussians are asked for (`gnd.gnd_map.codec.encode_mask`)."""
    reason: str = ""
    """Why it was quarantined or is to be sent whole, in one line with numbers."""

    def __post_init__(self) -> None:
        check_report_id(self.report_id)
        check_word(self.status, _STATUS, "ReportState status")
        check_text("reason", self.reason, REASON_PATTERN)
        check_length("mask of ReportState", len(self.wanted), limits.MAX_WANTED_BYTES, "bytes")
        if (self.status == "wanted") != bool(self.wanted):
            raise BadValue(f"ReportState {self.status} with a mask of {len(self.wanted)} bytes: one asks for the other")


@dataclass(frozen=True, slots=True)
class ReportStates:
    """How far some reports of one vehicle have come."""

    states: tuple[ReportState, ...]

    def __post_init__(self) -> None:
        _check_count("ReportStates", len(self.states))

    @classmethod
    def fitting(cls, states: Iterable[ReportState]) -> "ReportStates":
        """As many of the states, from the first on, as one message holds: masks may be large."""
        chosen: list[ReportState] = []
        left = limits.MAX_REPORT_STATES_BYTES
        for state in states:
            left -= len(state.wanted) + len(state.reason.encode()) + 64
            if chosen and left < 0:
                break
            chosen.append(state)
        return cls(tuple(chosen[: limits.MAX_REPORTS_OF_QUESTION]))

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ReportStates."""
        message = report_states_pb2.ReportStates(major=MAJOR, states=map(state_message, self.states))
        return serialise(message, limits.MAX_REPORT_STATES_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ReportStates":
        """The value in `data`; `SchemaError` when it is none."""
        kind = report_states_pb2.ReportStates
        most = limits.MAX_REPORTS_OF_QUESTION + 16
        message = parse(kind, data, limits.MAX_REPORT_STATES_BYTES, max_fields=most)
        check_major(message, "ReportStates")
        return cls(tuple(map(state_value, message.states)))


@dataclass(frozen=True, slots=True)
class ReportQuestion:
    """Which reports a vehicle asks after."""

    report_ids: tuple[str, ...]

    def __post_init__(self) -> None:
        _check_count("ReportQuestion", len(self.report_ids))
        for report_id in self.report_ids:
            check_report_id(report_id)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ReportQuestion."""
        ids = map(bytes_of_report_id, self.report_ids)
        message = report_question_pb2.ReportQuestion(major=MAJOR, report_ids=ids)
        return serialise(message, limits.MAX_REPORT_QUESTION_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ReportQuestion":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(report_question_pb2.ReportQuestion, data, limits.MAX_REPORT_QUESTION_BYTES)
        check_major(message, "ReportQuestion")
        return cls(tuple(map(report_id_of_bytes, message.report_ids)))


def _check_count(name: str, count: int) -> None:
    if not 1 <= count <= limits.MAX_REPORTS_OF_QUESTION:
        raise BadValue(f"{name} is about {count} reports, expected 1 to {limits.MAX_REPORTS_OF_QUESTION}")


def state_message(state: ReportState) -> report_state_pb2.ReportState:
    """A state as messages carry it."""
    message = report_state_pb2.ReportState(
        report_id=bytes_of_report_id(state.report_id), wanted=state.wanted, reason=state.reason
    )
    message.status = report_state_pb2.ReportState.Status.ValueType(number_of(state.status, _STATUS))
    return message


def state_value(message: report_state_pb2.ReportState) -> ReportState:
    """The state in a message; `SchemaError` when it is none."""
    return ReportState(
        report_id=report_id_of_bytes(message.report_id),
        status=word_of(message.status, _STATUS, "ReportState status"),
        wanted=message.wanted,
        reason=message.reason,
    )
