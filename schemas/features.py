"""Reports about feature layers: what a drive found out about signs, lanes, lamps, poles of the tiles it left behind.

Like a report about voxels it is a statement about the world. It says of every map feature that it judges what this
drive alone saw of it, and over which cells of the tile it would have seen a feature had there been one: the merger
needs those who looked and saw nothing. On the wire it is a ChangeReport with nothing but `major` and `features` set.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.feature_change import EVERY_CELL, GRID, FeatureChange, Found, Seen, cell_of
from gnd.schemas.feature_wire import change_message, change_of
from gnd.schemas.generated import change_report_pb2, feature_change_pb2, feature_report_pb2
from gnd.schemas.report_head import check_report_head, check_tiles_of_district
from gnd.schemas.report_id import bytes_of_report_id, report_id_of_bytes
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    check_length,
    check_major,
    check_text,
    parse,
    refusing,
    serialise,
)
from gnd.schemas.wire_fields import check_field_count, submessages

__all__ = [
    "EVERY_CELL",
    "GRID",
    "FeatureChange",
    "FeatureReport",
    "Found",
    "Seen",
    "cell_of",
    "check_feature_bytes",
    "report_of",
    "split_features",
]

FIELD: Final = "features"
_NAME: Final = "FeatureReport"
_NUMBER: Final = change_report_pb2.ChangeReport.DESCRIPTOR.fields_by_name[FIELD].number


@dataclass(frozen=True, slots=True)
class FeatureReport:
    """What a vehicle sends about one feature layer of the tiles of one district that it has left behind."""

    report_id: str
    """ULID; the same report keeps its id whenever it is sent again."""
    vehicle: str
    """Pseudonym."""
    sensor_model: str
    software: str
    layer: str
    """Such as "signs"; never one that begins with "ndt"."""
    district: District
    first_ns: int
    """Time of the first look that the report rests on, UTC."""
    last_ns: int
    """Time of the last look."""
    tiles: tuple[FeatureChange, ...]
    """One entry a tile, ascending; at least one."""

    def __post_init__(self) -> None:
        check_report_head(self)
        check_text("layer", self.layer, LAYER_PATTERN)
        if not is_feature_layer(self.layer):
            raise BadValue(f"report {self.report_id} speaks of features, layer {self.layer!r} holds Gaussians")
        check_tiles_of_district(self.report_id, self.district, self.tiles)
        _check_amount(sum(one.n_features for one in self.tiles), sum(one.n_points for one in self.tiles))

    def snapped(self) -> "FeatureReport":
        """As it is after a journey: positions in whole millimetres, masses in 1/10,000, covariances on levels."""
        return replace(self, tiles=tuple(change.snapped() for change in self.tiles))

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ChangeReport with `features` set, of the report as `snapped` gives it.

        Raises:
            TooLarge: a reader would refuse them.
        """
        features = feature_report_pb2.FeatureReport(
            report_id=bytes_of_report_id(self.report_id),
            vehicle=self.vehicle,
            sensor_model=self.sensor_model,
            software=self.software,
            layer=self.layer,
            district=self.district.path,
            first_ns=self.first_ns,
            length_ns=self.last_ns - self.first_ns,
            tiles=(change_message(change.snapped()) for change in self.tiles),
        )
        message = change_report_pb2.ChangeReport(major=MAJOR, features=features)
        return serialise(message, limits.MAX_FEATURE_REPORT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "FeatureReport":
        """The value in `data`; `SchemaError` when it is none."""
        check_feature_bytes(data)
        message = parse(
            change_report_pb2.ChangeReport, data, limits.MAX_FEATURE_REPORT_BYTES, max_fields=limits.MAX_REPORT_FIELDS
        )
        check_major(message, _NAME)
        others = sorted(field.name for field, _ in message.ListFields() if field.name not in ("major", FIELD))
        if others or not message.HasField(FIELD):
            raise BadValue(f"{len(data)} bytes are no {_NAME} but a ChangeReport of {', '.join(others) or 'nothing'}")
        return report_of(message.features)


def check_feature_bytes(data: bytes) -> None:
    """Refuse, without parsing it, a message whose feature report is larger than one may be, or of too many tiles.

    Raises:
        TooLarge: more bytes or fields, or reports: a parser would make one large report of many.
        Malformed: the bytes are not fields.
    """
    for count, report in enumerate(submessages("ChangeReport", data, _NUMBER, limits.MAX_REPORT_FIELDS), start=1):
        check_length("ChangeReport", count, 1, "reports of features")
        check_length(_NAME, len(data), limits.MAX_FEATURE_REPORT_BYTES, "bytes")
        check_field_count(_NAME, report, limits.MAX_REPORT_FIELDS)


def report_of(message: feature_report_pb2.FeatureReport) -> FeatureReport:
    """The checked report of a parsed message; `SchemaError` when it is none."""
    check_length(_NAME, len(message.tiles), limits.MAX_TILES_OF_DISTRICT, "tiles")
    with refusing(_NAME):
        district = District(message.district)
    return FeatureReport(
        report_id=report_id_of_bytes(message.report_id),
        vehicle=message.vehicle,
        sensor_model=message.sensor_model,
        software=message.software,
        layer=message.layer,
        district=district,
        first_ns=message.first_ns,
        last_ns=message.first_ns + message.length_ns,
        tiles=_changes(message.tiles),
    )


def _changes(messages: Sequence[feature_change_pb2.FeatureChange]) -> tuple[FeatureChange, ...]:
    """Tile by tile, so that a report that unpacks to much is refused before all of it has."""
    changes: list[FeatureChange] = []
    features = points = 0
    for message in messages:
        change = change_of(message)
        features, points = features + change.n_features, points + change.n_points
        _check_amount(features, points)
        changes.append(change)
    return tuple(changes)


def _check_amount(features: int, points: int) -> None:
    """`TooLarge` when all tiles of a report together hold more than a report may."""
    check_length(_NAME, features, limits.MAX_FEATURES_OF_REPORT, "features")
    check_length(_NAME, points, limits.MAX_POINTS_OF_REPORT, "points")


def split_features(report: FeatureReport) -> tuple[tuple[TileId, bytes], ...]:
    """One self-contained encoded report a tile, under the same report id: what the store keeps."""
    return tuple((change.tile, replace(report, tiles=(change,)).encode()) for change in report.tiles)
