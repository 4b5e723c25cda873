"""Change reports: what a drive found out about the tiles that it left behind, and the merger's answer.

A report is a statement about the world ("Gaussian G here", "nothing here", "as in version v"), so it keeps its meaning
when the map has moved on. Every voxel that the drive has observed is named: the merger's votes need those who saw no
change, too.
"""

from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import I32, are_in, check_array
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import CODEC_FLOAT32, codec_of, encode_gaussians
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.bitmap import decode_observed, encode_observed
from gnd.schemas.course import Course, course_message, course_value
from gnd.schemas.doubt import Doubt, doubt_message, doubt_value
from gnd.schemas.errors import BadValue, TooLarge
from gnd.schemas.generated import change_ack_pb2, change_report_pb2, tile_change_pb2
from gnd.schemas.report_head import check_report_head, check_tiles_of_district
from gnd.schemas.report_id import check_report_id
from gnd.schemas.report_states import ReportState, state_message, state_value
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    REASON_PATTERN,
    check_length,
    check_major,
    check_pair,
    check_text,
    check_word,
    number_of,
    parse,
    refusing,
    serialise,
    tile_id,
    word_of,
)

U8 = npt.NDArray[np.uint8]

AckStatus = Literal["stored", "duplicate", "quarantined", "wanted", "resend"]
_STATUS: Final[dict[int, AckStatus]] = {1: "stored", 2: "duplicate", 3: "quarantined", 4: "wanted", 5: "resend"}
_MAY_BE_UNNAMED: Final = ("quarantined", "stored", "duplicate")
_COUNTERS: Final = 4
_LAST_CLASS: Final = int(max(ChangeClass))
_ROUNDING: Final = 1e-5
"""How negative an eigenvalue of a float32 covariance may be, relative to the largest: a plane's smallest is about 0."""


@dataclass(frozen=True, slots=True)
class _AboutTile:
    """What an error is about; written out only when there is one, for that takes longer than the checks."""

    tile: TileId

    def __str__(self) -> str:
        return f"change of tile {self.tile}"


@dataclass(frozen=True, slots=True, eq=False)
class TileChange:
    """What one drive found out about one tile."""

    tile: TileId
    base_version: int
    """Version that the vehicle compared with; 0 = it had no map of this tile."""
    base_sha: bytes
    """SHA-256 of that version's content; empty = it had no map of this tile."""
    observed: I32
    """(K,) sorted ids of the voxels that this drive has observed."""
    changed: Gaussians
    """N voxels among the observed; count 0 = there is nothing now. Observed but not listed = as in the base."""
    change_class: U8
    """(N,) `ChangeClass` of each changed voxel."""
    evidence: I32
    """(N, 4) rays of each changed voxel: blocked inside n_BI, outside n_BO, in empty n_BE, passed inside n_PI."""
    pose_sigma_m: float
    """Standard deviation of the refined position, in its worst direction, over the scans that saw the tile."""
    pose_sigma_rad: float
    """Standard deviation of the refined attitude, about its worst axis, over the same scans."""
    doubt: Doubt | None = None
    """Why the vehicle does not fully believe this; None = it does."""
    unsure: Gaussians = field(default_factory=Gaussians.empty)
    """Where the base holds nothing and the drive met something, but too little to decide: U voxels, none observed.
    `count` and `cells` are the sub-cells that half as many points would have met, 1 to 19."""

    def __post_init__(self) -> None:
        with refusing(_AboutTile(self.tile)):
            check_pair("base", self.base_version, self.base_sha)
            check_array("observed", self.observed, np.int32, (None,))
            check_array("change_class", self.change_class, np.uint8, (len(self.changed),))
            check_array("evidence", self.evidence, np.int32, (len(self.changed), _COUNTERS))
            self._check_voxels()
            self._check_values()
            _check_covariances(self.changed)
            if len(self.unsure):
                self._check_unsure()
            self._check_withheld()

    def _check_withheld(self) -> None:
        named = len(self.observed) + len(self.unsure)
        if self.doubt is not None and self.doubt.withheld and named:
            raise BadValue(f"{self.doubt.withheld} changes are held back, and {named} voxels are named all the same")

    def _check_unsure(self) -> None:
        check_length("unsure", len(self.unsure), limits.MAX_UNSURE_OF_REPORT, "voxels")
        ids, cells = self.unsure.voxel_id, self.unsure.cells
        both = are_in(ids, self.observed)
        if both.any():
            raise BadValue(f"{both.sum()} voxels are unsure and observed, first {ids[both][0]}")
        if cells.min() < 1 or cells.max() > limits.MAX_UNSURE_CELLS:
            raise BadValue(f"unsure voxels of {cells.min()} .. {cells.max()} cells, not 1 .. {limits.MAX_UNSURE_CELLS}")
        if (self.unsure.count != cells).any():
            raise BadValue(f"{(self.unsure.count != cells).sum()} unsure voxels count points, not sub-cells")
        _check_covariances(self.unsure)
        _check_floors(self.tile, ids[[0, -1]])

    def _check_voxels(self) -> None:
        if not (self.observed[1:] > self.observed[:-1]).all():
            raise BadValue(f"the {len(self.observed)} observed voxels are not strictly increasing")
        outside = ~are_in(self.changed.voxel_id, self.observed)
        if outside.any():
            first = self.changed.voxel_id[outside][0]
            raise BadValue(f"{outside.sum()} changed voxels are not among the observed, first {first}")
        if len(self.observed):
            _check_floors(self.tile, self.observed[[0, -1]])

    def _check_values(self) -> None:
        if (self.change_class > _LAST_CLASS).any():
            raise BadValue(f"change class {self.change_class.max()} is outside 0 .. {_LAST_CLASS}")
        if (self.evidence < 0).any():
            raise BadValue(f"evidence of {self.evidence.min()} rays is negative")
        if not 0 <= self.pose_sigma_m <= limits.MAX_POSE_SIGMA_M:
            raise BadValue(f"pose sigma {self.pose_sigma_m} m is outside 0 .. {limits.MAX_POSE_SIGMA_M}")
        if not 0 <= self.pose_sigma_rad <= limits.MAX_POSE_SIGMA_RAD:
            raise BadValue(f"pose sigma {self.pose_sigma_rad} rad is outside 0 .. {limits.MAX_POSE_SIGMA_RAD}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TileChange) and self._scalars == other._scalars and self._same_arrays(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def _scalars(self) -> tuple[TileId, int, bytes, float, float, Doubt | None]:
        return self.tile, self.base_version, self.base_sha, self.pose_sigma_m, self.pose_sigma_rad, self.doubt

    def _same_arrays(self, other: "TileChange") -> bool:
        return (
            self.changed == other.changed
            and self.unsure == other.unsure
            and np.array_equal(self.observed, other.observed)
            and np.array_equal(self.change_class, other.change_class)
            and np.array_equal(self.evidence, other.evidence)
        )


def _check_floors(tile: TileId, voxel_id: I32) -> None:
    """Voxel ids of any number are voxels; those deep in the Earth or far above it are mistakes."""
    _, _, floor = VoxelGrid.of(tile).unravel(voxel_id)
    if floor.min() < limits.MIN_FLOOR or floor.max() > limits.MAX_FLOOR:
        known = f"{limits.MIN_FLOOR} .. {limits.MAX_FLOOR} m"
        raise BadValue(
            f"observed voxels lie at heights {floor.min()} .. {floor.max()} m, the Earth's surface at {known}"
        )


def _check_covariances(gaussians: Gaussians) -> None:
    """Refuse covariances that no points inside a voxel can have: not positive semi-definite, or too large."""
    if not gaussians.count.any():
        return
    eigenvalues = np.linalg.eigvalsh(gaussians.full_cov())
    smallest, largest = eigenvalues[:, 0], eigenvalues[:, -1]
    bad = (smallest < -_ROUNDING * largest) | (largest > limits.MAX_VARIANCE_M2)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise BadValue(
            f"{bad.sum()} covariances are not positive or too large: voxel {gaussians.voxel_id[row]} has eigenvalues "
            f"{smallest[row]:.4g} .. {largest[row]:.4g} m^2, expected 0 .. {limits.MAX_VARIANCE_M2}"
        )


@dataclass(frozen=True, slots=True)
class ChangeReport:
    """What a vehicle sends for the tiles of one district that it has left behind."""

    report_id: str
    """ULID; the same report keeps its id whenever it is sent again."""
    vehicle: str
    """Pseudonym."""
    sensor_model: str
    software: str
    district: District
    first_ns: int
    """Time of the first scan that the report rests on, UTC."""
    last_ns: int
    """Time of the last scan."""
    tiles: tuple[TileChange, ...]
    """One entry a tile, ascending; at least one."""
    layer: str = "ndt"
    course: Course | None = None
    """Where the vehicle drives in its own frame; None = it does not know."""

    def __post_init__(self) -> None:
        check_report_head(self)
        check_text("layer", self.layer, LAYER_PATTERN)
        check_tiles_of_district(self.report_id, self.district, self.tiles)
        _check_observed(sum(len(change.observed) for change in self.tiles), len(self.tiles))
        _check_unsure(sum(len(change.unsure) for change in self.tiles), len(self.tiles))

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeReport."""
        message = change_report_pb2.ChangeReport(
            major=MAJOR,
            report_id=self.report_id,
            vehicle=self.vehicle,
            sensor_model=self.sensor_model,
            software=self.software,
            layer=self.layer,
            district=self.district.path,
            first_ns=self.first_ns,
            last_ns=self.last_ns,
            tiles=map(_change_message, self.tiles),
            course=course_message(self.course),
        )
        return serialise(message, limits.MAX_CHANGE_REPORT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ChangeReport":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(
            change_report_pb2.ChangeReport, data, limits.MAX_CHANGE_REPORT_BYTES, max_fields=limits.MAX_REPORT_FIELDS
        )
        check_major(message, "ChangeReport")
        if any(message.HasField(form) for form in ("packed", "gaussians", "features", "survey")):
            raise BadValue("ChangeReport in short, of features or of a survey: here only a whole report is read")
        check_length("ChangeReport", len(message.tiles), limits.MAX_TILES_OF_DISTRICT, "tiles")
        with refusing("ChangeReport"):
            district = District(message.district)
        return cls(
            report_id=message.report_id,
            vehicle=message.vehicle,
            sensor_model=message.sensor_model,
            software=message.software,
            layer=message.layer,
            district=district,
            first_ns=message.first_ns,
            last_ns=message.last_ns,
            tiles=_change_values(message),
            course=course_value(message.course) if message.HasField("course") else None,
        )


def _change_message(change: TileChange) -> tile_change_pb2.TileChange:
    first, bitmap = encode_observed(change.observed)
    return tile_change_pb2.TileChange(
        tile=change.tile.morton,
        base_version=change.base_version,
        base_sha=change.base_sha,
        observed_first=first,
        observed_bitmap=bitmap,
        codec_id=CODEC_FLOAT32,
        changed=encode_gaussians(change.changed),
        change_class=change.change_class.tobytes(),
        evidence=change.evidence.ravel().tolist(),
        pose_sigma_m=change.pose_sigma_m,
        pose_sigma_rad=change.pose_sigma_rad,
        doubt=None if change.doubt is None else doubt_message(change.doubt),
        unsure=encode_gaussians(change.unsure) if len(change.unsure) else b"",
    )


def _change_values(message: change_report_pb2.ChangeReport) -> tuple[TileChange, ...]:
    """Tile by tile, so that a report made of many bitmaps that unpack to much is refused before it has unpacked all."""
    changes: list[TileChange] = []
    observed = unsure = 0
    for change in message.tiles:
        changes.append(_change_value(change))
        observed += len(changes[-1].observed)
        _check_observed(observed, len(changes))
        unsure += len(changes[-1].unsure)
        _check_unsure(unsure, len(changes))
    return tuple(changes)


def _check_observed(voxels: int, tiles: int) -> None:
    if voxels > limits.MAX_OBSERVED_OF_REPORT:
        raise TooLarge(f"report observes more than {limits.MAX_OBSERVED_OF_REPORT} voxels in {tiles} tiles")


def _check_unsure(voxels: int, tiles: int) -> None:
    if voxels > limits.MAX_UNSURE_OF_REPORT:
        raise TooLarge(f"report is unsure of more than {limits.MAX_UNSURE_OF_REPORT} voxels in {tiles} tiles")


def _change_value(message: tile_change_pb2.TileChange) -> TileChange:
    tile = tile_id(message.tile)
    with refusing(_AboutTile(tile)):
        observed = decode_observed(message.observed_first, message.observed_bitmap)
        codec = codec_of(message.codec_id)
        changed = codec.decode(tile, message.changed)
        evidence = _evidence_of(message, len(changed))
        doubt = doubt_value(message.doubt) if message.HasField("doubt") else None
        unsure = codec.decode(tile, message.unsure) if message.unsure else Gaussians.empty()
    return TileChange(
        tile=tile,
        base_version=message.base_version,
        base_sha=message.base_sha,
        observed=observed,
        changed=changed,
        change_class=np.frombuffer(message.change_class, np.uint8).copy(),
        evidence=evidence,
        pose_sigma_m=message.pose_sigma_m,
        pose_sigma_rad=message.pose_sigma_rad,
        doubt=doubt,
        unsure=unsure,
    )


def _evidence_of(message: tile_change_pb2.TileChange, n: int) -> I32:
    if len(message.evidence) != _COUNTERS * n:
        raise BadValue(f"{len(message.evidence)} counters of rays for {n} changed voxels, expected {_COUNTERS * n}")
    counters = np.array(message.evidence, np.int64).reshape(n, _COUNTERS)
    if (counters >= 2**31).any():
        raise BadValue(f"evidence of {counters.max()} rays does not fit 31 bits")
    return counters.astype(np.int32)


def split(report: ChangeReport) -> tuple[tuple[TileId, bytes], ...]:
    """One self-contained encoded report a tile, under the same report id: what the store keeps."""
    return tuple((change.tile, replace(report, tiles=(change,)).encode()) for change in report.tiles)


@dataclass(frozen=True, slots=True)
class ChangeAck:
    """The merger's answer to a report. "stored" and "duplicate" are sent only when all of it is durable."""

    report_id: str
    """The report that is answered; empty when it was too broken to have an id, and where the seal of the answer shows
    to which question it is one (`unnamed`)."""
    status: AckStatus
    reason: str = ""
    """Why it was quarantined or is to be sent again, in one line with numbers."""
    wanted: bytes = b""
    """Status "wanted": of which new and modified voxels Gaussians are asked for (`gnd.gnd_map.codec.encode_mask`)."""
    told: tuple[ReportState, ...] = ()
    """How far earlier reports of the vehicle have come that were patient."""

    def __post_init__(self) -> None:
        if self.report_id or self.status not in _MAY_BE_UNNAMED:
            check_report_id(self.report_id)
        check_word(self.status, _STATUS, "ChangeAck status")
        check_text("reason", self.reason, REASON_PATTERN)
        check_length("mask of ChangeAck", len(self.wanted), limits.MAX_WANTED_BYTES, "bytes")
        check_length("ChangeAck", len(self.told), limits.MAX_STATES_OF_ACK, "states of reports")
        if (self.status == "wanted") != bool(self.wanted):
            raise BadValue(f"ChangeAck {self.status} with a mask of {len(self.wanted)} bytes: one asks for the other")

    def unnamed(self) -> "ChangeAck":
        """Without the report's id, where it may be left out: 28 bytes less."""
        return replace(self, report_id="") if self.status in _MAY_BE_UNNAMED else self

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeAck."""
        told = map(state_message, self.told)
        message = change_ack_pb2.ChangeAck(
            major=MAJOR, report_id=self.report_id, reason=self.reason, wanted=self.wanted, told=told
        )
        message.status = change_ack_pb2.ChangeAck.Status.ValueType(number_of(self.status, _STATUS))
        return serialise(message, limits.MAX_CHANGE_ACK_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ChangeAck":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(change_ack_pb2.ChangeAck, data, limits.MAX_CHANGE_ACK_BYTES)
        check_major(message, "ChangeAck")
        status = word_of(message.status, _STATUS, "ChangeAck status")
        check_length("ChangeAck", len(message.told), limits.MAX_STATES_OF_ACK, "states of reports")
        return cls(message.report_id, status, message.reason, message.wanted, tuple(map(state_value, message.told)))
