"""Surveys: what a vehicle maps where the map has no road. On the wire a ChangeReport with nothing but `survey` set.

A survey is a chain of submaps, each some ten metres of way in a frame of its own, with its pose in the frame of the one
before. Where the map still holds the vehicle, at the edge, anchors say where a submap lies on it; positions from
satellites go along. A long survey travels in parts, each a report that the outbox keeps until the cloud has it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.geodesy import check_geodetic
from gnd.gnd_map.se3 import T_from_R_t, exp_so3, log_so3
from gnd.gnd_map.submap import REACH_TILES, Column, SubmapGaussians, decode_submap
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import change_report_pb2, survey_anchor_pb2, survey_report_pb2, survey_submap_pb2
from gnd.schemas.report_head import check_report_head
from gnd.schemas.report_id import bytes_of_report_id, check_report_id, report_id_of_bytes
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    check_length,
    check_major,
    check_text,
    check_unsigned,
    parse,
    refusing,
    serialise,
    tile_id,
)
from gnd.schemas.wire_fields import check_field_count, submessages

SURVEY_FIELD: Final = "survey"
_NUMBER: Final = change_report_pb2.ChangeReport.DESCRIPTOR.fields_by_name[SURVEY_FIELD].number
_MAX_FIELDS: Final = 2 * limits.MAX_SUBMAPS_OF_SURVEY_PART + limits.MAX_FIXES_OF_SURVEY_PART + 64
_UPPER: Final = np.triu_indices(6)
_MAX_PLACE_M: Final = 150.0
"""A vehicle is not farther from the origin of its submap; the grid of submaps reaches as far."""
_MAX_POSE_M: Final = 50_000.0
"""A pose in the frame of a tile."""


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMotion:
    """A pose (4, 4) and its covariance (6, 6) of a small motion at its end, rotation [rad] before translation [m]."""

    T: F64
    covariance: F64

    def __post_init__(self) -> None:
        check_pose("pose of a survey", self.T)
        check_covariance("covariance of a survey", self.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class SurveySubmap:
    """What was seen along some metres of way, in the vehicle frame at its beginning.

    Attributes:
        number: in the survey, from 0 on.
        t_ns: of its beginning, UTC.
        step: T_before_this, the pose in the frame of the submap before; None of the first.
        bodies: the Gaussians by tile of the submap's grid (`gnd_map.submap`).
    """

    number: int
    t_ns: int
    step: SurveyMotion | None
    bodies: Mapping[Column, bytes] = field(repr=False)

    def __post_init__(self) -> None:
        check_unsigned("submap number", self.number, bits=31)
        check_unsigned("submap time", self.t_ns, bits=63)
        if (self.step is None) != (self.number == 0):
            raise BadValue(f"submap {self.number}: all but the first, and only they, have a step from the one before")
        if self.step is not None and np.linalg.norm(self.step.T[:3, 3]) > limits.MAX_STEP_OF_SURVEY_M:
            far_m = np.linalg.norm(self.step.T[:3, 3])
            raise BadValue(f"submap {self.number} lies {far_m:.1f} m from the one before, the limit is "
                           f"{limits.MAX_STEP_OF_SURVEY_M:g} m")  # fmt: skip
        check_length(f"submap {self.number}", len(self.bodies), limits.MAX_TILES_OF_SUBMAP, "tiles")
        if any(max(abs(east), abs(north)) > REACH_TILES for east, north in self.bodies):
            raise BadValue(f"submap {self.number}: its tiles reach beyond {REACH_TILES} to a side: {list(self.bodies)}")

    def gaussians(self) -> SubmapGaussians:
        """What it holds; `SchemaError` when the bodies are no Gaussians, or too many."""
        with refusing(f"submap {self.number}"):
            found = decode_submap(self.bodies)
        check_length(f"submap {self.number}", len(found), limits.MAX_GAUSSIANS_OF_SUBMAP, "Gaussians")
        return found


@dataclass(frozen=True, slots=True, eq=False)
class SurveyFix:
    """A position from satellites [rad, m], its sigma, and where the vehicle was, (3,) in the frame of a submap."""

    submap: int
    place_m: F64
    lat_rad: float
    lon_rad: float
    height_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        with refusing(f"fix at submap {self.submap}"):
            check_geodetic(self.lat_rad, self.lon_rad)
        place = np.asarray(self.place_m)
        if place.shape != (3,) or not (np.abs(place) <= _MAX_PLACE_M).all():  # NaN fails, too
            raise BadValue(f"fix at submap {self.submap}: the vehicle at {place} m in its frame")
        if not (abs(self.height_m) < 1e5 and 0 < self.sigma_m < limits.MAX_POSE_SIGMA_M):
            raise BadValue(f"fix at submap {self.submap}: height {self.height_m} m, sigma {self.sigma_m} m")


@dataclass(frozen=True, slots=True, eq=False)
class SurveyAnchor:
    """The pose of a submap in the ENU frame of a tile, T_tile_submap, by the localiser of the vehicle."""

    submap: int
    tile: TileId
    pose: SurveyMotion


@dataclass(frozen=True, slots=True, eq=False)
class SurveyReport:
    """One part of a survey.

    Attributes:
        report_id: ULID of the part.
        survey_id: ULID of the survey, which is the report id of its first part.
        part: its number, from 0 on.
        is_last: no part follows.
        layer: of the voxel map.
        district: where the part begins.
        first_ns, last_ns: of its scans, UTC.
        submaps: at least one, with numbers that follow on each other.
    """

    report_id: str
    survey_id: str
    part: int
    is_last: bool
    vehicle: str
    sensor_model: str
    software: str
    layer: str
    district: District
    first_ns: int
    last_ns: int
    submaps: tuple[SurveySubmap, ...]
    fixes: tuple[SurveyFix, ...] = ()
    anchors: tuple[SurveyAnchor, ...] = ()

    def __post_init__(self) -> None:
        check_report_head(self)
        check_report_id(self.survey_id)
        check_text("layer", self.layer, LAYER_PATTERN)
        if is_feature_layer(self.layer):
            raise BadValue(f"survey {self.survey_id} maps Gaussians, layer {self.layer!r} holds features")
        if not 0 <= self.part < limits.MAX_PARTS_OF_SURVEY:
            raise BadValue(f"survey {self.survey_id}: part {self.part}, a survey has {limits.MAX_PARTS_OF_SURVEY}")
        if (self.part == 0) != (self.report_id == self.survey_id):
            raise BadValue(f"part {self.part} of survey {self.survey_id} is report {self.report_id}: the first part "
                           "gives the survey its id")  # fmt: skip
        self._check_submaps()

    def _check_submaps(self) -> None:
        what, numbers = f"part {self.part} of survey {self.survey_id}", [one.number for one in self.submaps]
        if not numbers:
            raise BadValue(f"{what} has no submaps")
        check_length(what, len(numbers), limits.MAX_SUBMAPS_OF_SURVEY_PART, "submaps")
        check_length(what, len(self.fixes), limits.MAX_FIXES_OF_SURVEY_PART, "fixes")
        check_length(what, len(self.anchors), limits.MAX_SUBMAPS_OF_SURVEY_PART, "anchors")
        if any(after != before + 1 for before, after in pairwise(numbers)) or (self.part == 0) != (numbers[0] == 0):
            raise BadValue(f"{what} has submaps {numbers}: they follow on each other, number 0 begins part 0")
        told_of = {fix.submap for fix in self.fixes} | {anchor.submap for anchor in self.anchors}
        strangers = told_of - set(numbers)
        if strangers:
            raise BadValue(f"{what} tells of submaps {sorted(strangers)}, it has {numbers[0]} to {numbers[-1]}")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeReport with `survey` set; `TooLarge` when a reader would refuse them."""
        survey = survey_report_pb2.SurveyReport(
            report_id=bytes_of_report_id(self.report_id),
            survey_id=bytes_of_report_id(self.survey_id),
            part=self.part,
            is_last=self.is_last,
            vehicle=self.vehicle,
            sensor_model=self.sensor_model,
            software=self.software,
            layer=self.layer,
            district=self.district.path,
            first_ns=self.first_ns,
            length_ns=self.last_ns - self.first_ns,
            submaps=(_submap_message(one, self.first_ns) for one in self.submaps),
        )
        for fix in self.fixes:
            survey.fixes.add(
                submap=fix.submap, place_m=fix.place_m, lat_rad=fix.lat_rad, lon_rad=fix.lon_rad,
                height_m=fix.height_m, sigma_m=fix.sigma_m,
            )  # fmt: skip
        for anchor in self.anchors:
            pose, covariance = _numbers_of(anchor.pose)
            survey.anchors.add(submap=anchor.submap, tile=anchor.tile.morton, pose=pose, covariance=covariance)
        return serialise(change_report_pb2.ChangeReport(major=MAJOR, survey=survey), limits.MAX_SURVEY_REPORT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "SurveyReport":
        """The value in `data`; `SchemaError` when it is none."""
        check_survey_bytes(data)
        message = parse(
            change_report_pb2.ChangeReport, data, limits.MAX_SURVEY_REPORT_BYTES, max_fields=limits.MAX_REPORT_FIELDS
        )
        check_major(message, "SurveyReport")
        others = sorted(one.name for one, _ in message.ListFields() if one.name not in ("major", SURVEY_FIELD))
        if others or not message.HasField(SURVEY_FIELD):
            raise BadValue(f"{len(data)} bytes are no SurveyReport but a ChangeReport of {', '.join(others) or 'none'}")
        return survey_of(message.survey)


def check_survey_bytes(data: bytes) -> None:
    """Refuse, without parsing it, a message with more than one survey, or one of more fields than a part may have.

    Raises:
        TooLarge: more reports, bytes or fields: a parser makes an object of every two bytes of empty submaps.
        Malformed: the bytes are not fields.
    """
    for count, survey in enumerate(submessages("ChangeReport", data, _NUMBER, limits.MAX_REPORT_FIELDS), start=1):
        check_length("ChangeReport", count, 1, "surveys")
        check_length("SurveyReport", len(data), limits.MAX_SURVEY_REPORT_BYTES, "bytes")
        check_field_count("SurveyReport", survey, _MAX_FIELDS)


def is_survey(data: bytes) -> bool:
    """Whether a message holds a part of a survey; it is not read.

    Raises:
        TooLarge: of more fields than a message to the cloud has.
        Malformed: the bytes are not fields.
    """
    return any(True for _ in submessages("ChangeReport", data, _NUMBER, limits.MAX_REPORT_FIELDS))


def survey_of(message: survey_report_pb2.SurveyReport) -> SurveyReport:
    """The checked part of a parsed message; `SchemaError` when it is none."""
    with refusing("SurveyReport"):
        district = District(message.district)
    check_length("SurveyReport", len(message.submaps), limits.MAX_SUBMAPS_OF_SURVEY_PART, "submaps")
    check_length("SurveyReport", len(message.fixes), limits.MAX_FIXES_OF_SURVEY_PART, "fixes")
    return SurveyReport(
        report_id=report_id_of_bytes(message.report_id),
        survey_id=report_id_of_bytes(message.survey_id),
        part=message.part,
        is_last=message.is_last,
        vehicle=message.vehicle,
        sensor_model=message.sensor_model,
        software=message.software,
        layer=message.layer,
        district=district,
        first_ns=message.first_ns,
        last_ns=message.first_ns + message.length_ns,
        submaps=tuple(_submap_of(one, message.first_ns) for one in message.submaps),
        fixes=tuple(
            SurveyFix(f.submap, np.array(f.place_m, np.float64), f.lat_rad, f.lon_rad, f.height_m, f.sigma_m)
            for f in message.fixes
        ),
        anchors=tuple(_anchor_of(one) for one in message.anchors),
    )


def _submap_message(one: SurveySubmap, first_ns: int) -> survey_submap_pb2.SurveySubmap:
    motion, covariance = ([], []) if one.step is None else _numbers_of(one.step)
    side = REACH_TILES + 1
    return survey_submap_pb2.SurveySubmap(
        number=one.number,
        after_ns=one.t_ns - first_ns,
        motion=motion,
        covariance=covariance,
        tile=[(east + side) * 2 * side + north + side for east, north in sorted(one.bodies)],
        body=[one.bodies[column] for column in sorted(one.bodies)],
    )


def _submap_of(message: survey_submap_pb2.SurveySubmap, first_ns: int) -> SurveySubmap:
    what, side = f"submap {message.number}", REACH_TILES + 1
    check_length(what, len(message.tile), limits.MAX_TILES_OF_SUBMAP, "tiles")
    if len(message.tile) != len(message.body) or any(b <= a for a, b in pairwise(message.tile)):
        raise BadValue(f"{what}: {len(message.tile)} tiles and {len(message.body)} bodies: as many, tiles ascending")
    columns = [(number // (2 * side) - side, number % (2 * side) - side) for number in message.tile]
    step = None
    if message.motion or message.covariance:
        step = _motion_of(what, message.motion, message.covariance)
    bodies = dict(zip(columns, message.body, strict=True))
    return SurveySubmap(message.number, first_ns + message.after_ns, step, bodies)


def _anchor_of(message: survey_anchor_pb2.SurveyAnchor) -> SurveyAnchor:
    pose = _motion_of(f"anchor of submap {message.submap}", message.pose, message.covariance)
    return SurveyAnchor(message.submap, tile_id(message.tile), pose)


def _numbers_of(pose: SurveyMotion) -> tuple[list[float], list[float]]:
    return [*log_so3(pose.T[:3, :3]), *pose.T[:3, 3]], pose.covariance[_UPPER].tolist()


def _motion_of(what: str, motion: Iterable[float], covariance: Iterable[float]) -> SurveyMotion:
    moved, upper = np.array(list(motion), np.float64), np.array(list(covariance), np.float64)
    if moved.shape != (6,) or upper.shape != (21,):
        raise BadValue(f"{what}: {len(moved)} numbers of a pose and {len(upper)} of its covariance, need 6 and 21")
    small = np.abs(moved[:3]).max() <= np.pi + 1e-6  # first: the square of a huge number overflows; NaN fails, too
    if not (small and np.isfinite(moved).all() and np.isfinite(upper).all()) or (
        np.linalg.norm(moved[:3]) > np.pi + 1e-6
    ):
        raise BadValue(f"{what}: a pose or covariance that is not finite, or a turn of more than half a circle")
    full = np.zeros((6, 6))
    full[_UPPER] = upper
    full = full + full.T - np.diag(np.diag(full))
    return SurveyMotion(T_from_R_t(exp_so3(moved[:3]), moved[3:]), full)


def check_pose(name: str, T: F64) -> None:
    """`BadValue` unless T (4, 4) is a pose within reach of a tile's frame."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, 3]).max() > _MAX_POSE_M:
        raise BadValue(f"{name}: not a pose, or farther than {_MAX_POSE_M:g} m away: {T[:3, 3:].ravel()}")
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6:
        raise BadValue(f"{name}: its rotation is none")


def check_covariance(name: str, covariance: F64) -> None:
    """`BadValue` unless it is (6, 6), symmetric, positive definite and of a size that means something."""
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise BadValue(f"{name}: shape {covariance.shape}, or not finite")
    least, most = float(np.linalg.eigvalsh(covariance)[0]), float(np.diag(covariance).max())
    if least <= 0 or most > limits.MAX_POSE_SIGMA_M**2:
        raise BadValue(f"{name}: eigenvalues from {least:.3g}, variances to {most:.3g}; it must be positive definite")
