"""Change reports in short, in two halves: first the flags of what changed, then the Gaussians that the ack asks for.
`decode_upload` reads whatever comes on the key of change reports.

Both travel in the message ChangeReport on the key of change reports. What they hold is coded against the versions of
the tiles that vehicle and cloud both have, so these values only carry the bytes: `vehicle_agent.report.packing` makes
them, `gnd.cloud_merger.expanding` understands them.
"""

import hashlib
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from gnd.gnd_map.codec import decode_tiles, encode_tiles
from gnd.schemas import limits
from gnd.schemas.changes import ChangeReport
from gnd.schemas.course import Course, course_message, course_value
from gnd.schemas.doubt import Doubt, doubt_message, doubt_value
from gnd.schemas.errors import BadValue, TooLarge
from gnd.schemas.features import FeatureReport, check_feature_bytes, report_of
from gnd.schemas.generated import change_report_pb2, packed_gaussians_pb2, packed_report_pb2
from gnd.schemas.report_head import check_report_head
from gnd.schemas.report_id import bytes_of_report_id, check_report_id, report_id_of_bytes
from gnd.schemas.survey import SURVEY_FIELD, SurveyReport, check_survey_bytes
from gnd.schemas.wire import (
    MAJOR,
    check_length,
    check_major,
    check_unsigned,
    check_version,
    parse,
    refusing,
    serialise,
)

DIGEST_BYTES: Final = 8
_FORMS: Final = {"packed": "PackedReport", "gaussians": "PackedGaussians", "features": "FeatureReport"}
_SIGMA_BITS: Final = 32
_INDEX_BITS: Final = 10
_M_PER_STEP: Final = 1e-4
_RAD_PER_STEP: Final = 1e-5


def digest_of(base_shas: Iterable[bytes]) -> bytes:
    """8 bytes of SHA-256 over the content hashes (32 bytes each, or none where there is no map) in order of tiles."""
    return hashlib.sha256(b"".join(base_shas)).digest()[:DIGEST_BYTES]


@dataclass(frozen=True, slots=True)
class PackedReport:
    """The first half of a report: what it rests on and which voxels it flags. Layer and district are in the key."""

    report_id: str
    """ULID; the same as that of the whole report."""
    vehicle: str
    """Pseudonym."""
    sensor_model: str
    software: str
    first_ns: int
    """Time of the first scan that the report rests on, UTC."""
    length_ns: int
    """Time from then to the last scan."""
    tiles: tuple[tuple[int, int], ...]
    """(index in the district: the lowest 10 bits of the Morton code, version of the base: 0 none), ascending, >= 1."""
    base_digest: bytes
    """`digest_of` the bases."""
    flags: bytes
    """Of `gnd.gnd_map.codec.encode_flags`."""
    track: bytes
    """Of `gnd.gnd_map.track.encode_track`."""
    pose_sigma_tenth_mm: int
    """Largest of the tiles' standard deviations of the refined position, 0.1 mm, rounded up."""
    pose_sigma_10urad: int
    """The same of the attitude, 10 µrad, rounded up."""
    doubts: tuple[tuple[int, Doubt], ...] = ()
    """(index in the district, doubt) of the tiles that are doubtful, ascending; nothing of them is held back."""
    course: Course | None = None
    """Where the vehicle drives in its own frame; None = it does not know."""
    unsure: bytes = b""
    """Of `gnd.gnd_map.codec.encode_flags`: voxels upon which the vehicle does not decide, all as new; empty: none."""
    unsure_measured: bytes = b""
    """Of `gnd.gnd_map.codec.encode_measured`: what it met there."""
    measured: bytes = b""
    """Of `gnd.gnd_map.codec.encode_measured`: the Gaussians of all new and modified voxels; empty: they are asked
    for."""
    is_patient: bool = False
    """The vehicle sends more, and hears with the ack of that that this report is released."""

    def __post_init__(self) -> None:
        check_report_head(self)
        if bool(self.unsure) != bool(self.unsure_measured):
            raise BadValue(
                f"packed report {self.report_id}: {len(self.unsure)} bytes of unsure voxels and "
                f"{len(self.unsure_measured)} of what was met there: one goes with the other"
            )
        check_unsigned("pose_sigma_tenth_mm", self.pose_sigma_tenth_mm, bits=_SIGMA_BITS)
        check_unsigned("pose_sigma_10urad", self.pose_sigma_10urad, bits=_SIGMA_BITS)
        if len(self.base_digest) != DIGEST_BYTES:
            raise BadValue(f"base digest has {len(self.base_digest)} bytes, expected {DIGEST_BYTES}")
        self._check_tiles()
        self._check_doubts()

    def _check_doubts(self) -> None:
        indices = [index for index, _ in self.doubts]
        if indices != sorted(set(indices)) or not set(indices) <= {index for index, _ in self.tiles}:
            raise BadValue(
                f"packed report {self.report_id}: its {len(indices)} doubtful tiles are not strictly ascending among "
                f"its {len(self.tiles)} tiles"
            )
        withheld = sum(doubt.withheld for _, doubt in self.doubts)
        if withheld:
            raise BadValue(f"packed report {self.report_id} holds back {withheld} changes: only a whole report can")

    def _check_tiles(self) -> None:
        if not self.tiles:
            raise BadValue(f"packed report {self.report_id} has no tiles")
        check_length(f"packed report {self.report_id}", len(self.tiles), limits.MAX_TILES_OF_DISTRICT, "tiles")
        indices = [index for index, _ in self.tiles]
        if indices != sorted(set(indices)):
            raise BadValue(f"packed report {self.report_id}: its {len(indices)} tiles are not strictly ascending")
        for index, version in self.tiles:
            check_unsigned("index of a tile", index, bits=_INDEX_BITS)
            check_version("base version", version, lowest=0)

    @property
    def last_ns(self) -> int:
        """Time of the last scan."""
        return self.first_ns + self.length_ns

    @property
    def pose_sigma_m(self) -> float:
        """Standard deviation of the refined position, metres."""
        return self.pose_sigma_tenth_mm * _M_PER_STEP

    @property
    def pose_sigma_rad(self) -> float:
        """Standard deviation of the refined attitude, radians."""
        return self.pose_sigma_10urad * _RAD_PER_STEP

    def doubt_of(self, index: int) -> Doubt | None:
        """Of the tile with this index in the district."""
        return dict(self.doubts).get(index)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeReport with `packed` set."""
        packed = packed_report_pb2.PackedReport(
            report_id=bytes_of_report_id(self.report_id),
            vehicle=self.vehicle,
            sensor_model=self.sensor_model,
            software=self.software,
            first_ns=self.first_ns,
            length_ns=self.length_ns,
            tiles=encode_tiles(self.tiles),
            base_digest=self.base_digest,
            flags=self.flags,
            track=self.track,
            pose_sigma_tenth_mm=self.pose_sigma_tenth_mm,
            pose_sigma_10urad=self.pose_sigma_10urad,
            doubtful=[index for index, _ in self.doubts],
            doubts=[doubt_message(doubt) for _, doubt in self.doubts],
            course=course_message(self.course),
            unsure=self.unsure,
            unsure_measured=self.unsure_measured,
            measured=self.measured,
            is_patient=self.is_patient,
        )
        message = change_report_pb2.ChangeReport(major=MAJOR, packed=packed)
        return serialise(message, limits.MAX_PACKED_REPORT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "PackedReport":
        """The value in `data`; `SchemaError` when it is none."""
        upload = decode_upload(data)
        if not isinstance(upload, cls):
            raise BadValue(f"{len(data)} bytes are no first half of a report but a {type(upload).__name__}")
        return upload


@dataclass(frozen=True, slots=True)
class PackedGaussians:
    """The second half of a report: the measured Gaussians that were asked for."""

    report_id: str
    """ULID of the report."""
    measured: bytes
    """Of `gnd.gnd_map.codec.encode_measured`."""
    wanted_crc: int
    """`crc_of` the bytes of the mask that asked for them."""

    def __post_init__(self) -> None:
        check_report_id(self.report_id)
        check_unsigned("wanted_crc", self.wanted_crc, bits=32)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeReport with `gaussians` set."""
        gaussians = packed_gaussians_pb2.PackedGaussians(
            report_id=bytes_of_report_id(self.report_id), measured=self.measured, wanted_crc=self.wanted_crc
        )
        message = change_report_pb2.ChangeReport(major=MAJOR, gaussians=gaussians)
        return serialise(message, limits.MAX_PACKED_GAUSSIANS_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "PackedGaussians":
        """The value in `data`; `SchemaError` when it is none."""
        upload = decode_upload(data)
        if not isinstance(upload, cls):
            raise BadValue(f"{len(data)} bytes are no second half of a report but a {type(upload).__name__}")
        return upload


def crc_of(wanted: bytes) -> int:
    """CRC-32 of an encoded mask."""
    return zlib.crc32(wanted)


def decode_upload(data: bytes) -> ChangeReport | PackedReport | PackedGaussians | FeatureReport | SurveyReport:
    """Whatever a vehicle has sent on the key of change reports.

    Raises:
        SchemaError: too large (checked before parsing), truncated, of another kind or major version, a value that
            cannot be; more than one form in one message.
    """
    _check_size("ChangeReport", data, limits.MAX_CHANGE_REPORT_BYTES)
    check_feature_bytes(data)
    check_survey_bytes(data)
    message = parse(
        change_report_pb2.ChangeReport, data, limits.MAX_CHANGE_REPORT_BYTES, max_fields=limits.MAX_REPORT_FIELDS
    )
    if message.HasField(SURVEY_FIELD):
        return SurveyReport.decode(data)
    forms = [name for name in _FORMS if message.HasField(name)]  # type: ignore[arg-type]
    if not forms:
        return ChangeReport.decode(data)
    check_major(message, _FORMS[forms[0]])
    others = sorted(field.name for field, _ in message.ListFields() if field.name not in ("major", forms[0]))
    if others:
        raise BadValue(f"ChangeReport holds {forms[0]} and also {', '.join(others)}: one report in one form")
    if forms[0] == "features":
        return report_of(message.features)
    if forms[0] == "packed":
        _check_size(_FORMS[forms[0]], data, limits.MAX_PACKED_REPORT_BYTES)
        return _packed_report(message.packed)
    _check_size(_FORMS[forms[0]], data, limits.MAX_PACKED_GAUSSIANS_BYTES)
    return _packed_gaussians(message.gaussians)


def _packed_report(message: packed_report_pb2.PackedReport) -> PackedReport:
    with refusing("tiles of PackedReport"):
        tiles = tuple(decode_tiles(message.tiles))
    if len(message.doubtful) != len(message.doubts):
        raise BadValue(f"PackedReport names {len(message.doubtful)} doubtful tiles and {len(message.doubts)} doubts")
    check_length("PackedReport", len(message.doubts), limits.MAX_TILES_OF_DISTRICT, "doubts")
    return PackedReport(
        report_id=report_id_of_bytes(message.report_id),
        vehicle=message.vehicle,
        sensor_model=message.sensor_model,
        software=message.software,
        first_ns=message.first_ns,
        length_ns=message.length_ns,
        tiles=tiles,
        base_digest=message.base_digest,
        flags=message.flags,
        track=message.track,
        pose_sigma_tenth_mm=message.pose_sigma_tenth_mm,
        pose_sigma_10urad=message.pose_sigma_10urad,
        doubts=tuple(zip(message.doubtful, map(doubt_value, message.doubts), strict=True)),
        course=course_value(message.course) if message.HasField("course") else None,
        unsure=message.unsure,
        unsure_measured=message.unsure_measured,
        measured=message.measured,
        is_patient=message.is_patient,
    )


def _packed_gaussians(message: packed_gaussians_pb2.PackedGaussians) -> PackedGaussians:
    return PackedGaussians(report_id_of_bytes(message.report_id), message.measured, message.wanted_crc)


def _check_size(name: str, data: bytes, limit: int) -> None:
    if len(data) > limit:
        raise TooLarge(f"{name} of {len(data)} bytes exceeds the limit of {limit} bytes")
