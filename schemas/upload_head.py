"""What the outside of an upload says, without reading what it holds: enough to keep it and to answer."""

from dataclasses import dataclass, replace
from typing import Final, Literal

from gnd.gnd_map.tile_id import District
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, TooLarge
from gnd.schemas.features import check_feature_bytes
from gnd.schemas.generated import change_report_pb2, feature_report_pb2, packed_report_pb2, survey_report_pb2
from gnd.schemas.report_id import check_report_id, report_id_of_bytes
from gnd.schemas.survey import SURVEY_FIELD, check_survey_bytes
from gnd.schemas.wire import (
    LAYER_PATTERN,
    VEHICLE_PATTERN,
    check_major,
    check_text,
    check_unsigned,
    parse,
    refusing,
)

UploadForm = Literal["packed", "gaussians", "whole", "features"]
_SHORT: Final[tuple[Literal["packed", "gaussians", "features"], ...]] = ("packed", "gaussians", "features")
_LIMITS: Final = {
    "packed": limits.MAX_PACKED_REPORT_BYTES,
    "gaussians": limits.MAX_PACKED_GAUSSIANS_BYTES,
    "features": limits.MAX_FEATURE_REPORT_BYTES,
    "whole": limits.MAX_CHANGE_REPORT_BYTES,
}


@dataclass(frozen=True, slots=True)
class UploadHead:
    """What an upload is and whose.

    Attributes:
        form: flags in short, Gaussians that were asked for, a whole report, or one about features.
        report_id: ULID.
        vehicle: pseudonym; "" of Gaussians, which do not tell it.
        last_ns: time of the last scan that it rests on, UTC; 0 of Gaussians.
        place: (layer, district) that it names itself; None where only its key does.
        is_patient: whether word that it is released may wait for the ack of the next one.
    """

    form: UploadForm
    report_id: str
    vehicle: str = ""
    last_ns: int = 0
    place: tuple[str, District] | None = None
    is_patient: bool = False


def head_of_upload(data: bytes) -> UploadHead:
    """The head of whatever a vehicle has sent on the key of change reports.

    Raises:
        SchemaError: too large (checked before parsing), truncated, of another kind or major version; no report id, no
            vehicle, times that cannot be; more than one form in one message.
    """
    check_feature_bytes(data)
    check_survey_bytes(data)
    message = parse(
        change_report_pb2.ChangeReport, data, limits.MAX_CHANGE_REPORT_BYTES, max_fields=limits.MAX_REPORT_FIELDS
    )
    forms = [name for name in _SHORT if message.HasField(name)]
    form: UploadForm = forms[0] if forms else "whole"
    check_major(message, "ChangeReport")
    if message.HasField(SURVEY_FIELD):
        return _head_of_survey(message, len(data))
    if forms:
        others = sorted(field.name for field, _ in message.ListFields() if field.name not in ("major", form))
        if others:
            raise BadValue(f"ChangeReport holds {form} and also {', '.join(others)}: one report in one form")
    if len(data) > _LIMITS[form]:
        raise TooLarge(f"upload in form {form} of {len(data)} bytes exceeds the limit of {_LIMITS[form]} bytes")
    if form == "gaussians":
        return UploadHead(form, report_id_of_bytes(message.gaussians.report_id))
    if form == "packed":
        packed = message.packed
        head = _head(form, report_id_of_bytes(packed.report_id), packed, packed.length_ns)
        return replace(head, is_patient=packed.is_patient)
    if form == "features":
        features = message.features
        report_id = report_id_of_bytes(features.report_id)
        return _head(form, report_id, features, features.length_ns, (features.layer, features.district))
    check_report_id(message.report_id)
    length_ns = message.last_ns - message.first_ns
    return _head(form, message.report_id, message, length_ns, (message.layer, message.district))


def _head_of_survey(message: change_report_pb2.ChangeReport, size: int) -> UploadHead:
    """A part of a survey goes whole, and is kept like a whole report."""
    others = sorted(field.name for field, _ in message.ListFields() if field.name not in ("major", SURVEY_FIELD))
    if others:
        raise BadValue(f"ChangeReport holds a survey and also {', '.join(others)}: one report in one form")
    if size > limits.MAX_SURVEY_REPORT_BYTES:
        raise TooLarge(f"survey of {size} bytes exceeds the limit of {limits.MAX_SURVEY_REPORT_BYTES} bytes")
    survey = message.survey
    report_id = report_id_of_bytes(survey.report_id)
    return _head("whole", report_id, survey, survey.length_ns, (survey.layer, survey.district))


def _head(
    form: UploadForm,
    report_id: str,
    message: change_report_pb2.ChangeReport
    | packed_report_pb2.PackedReport
    | feature_report_pb2.FeatureReport
    | survey_report_pb2.SurveyReport,
    length_ns: int,
    place: tuple[str, str] | None = None,
) -> UploadHead:
    check_text("vehicle", message.vehicle, VEHICLE_PATTERN)
    check_unsigned("first_ns", message.first_ns, bits=63)
    check_unsigned("last_ns - first_ns", length_ns, bits=63)
    named = None
    if place is not None:
        layer, path = place
        check_text("layer", layer, LAYER_PATTERN)
        with refusing("ChangeReport"):
            named = layer, District(path)
    return UploadHead(form, report_id, message.vehicle, message.first_ns + length_ns, named)
