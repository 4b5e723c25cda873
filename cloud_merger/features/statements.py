"""What the reports say of one tile of a feature layer, in the order of their ids and in the frame of this tile."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gnd.cloud_merger.features.rls import PlaceEstimate
from gnd.cloud_merger.features.spread import around, between, near_border
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Existence, Feature, feature_id_of
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_change import FeatureChange, Found, Seen
from gnd.schemas.features import FeatureReport

Attributes = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Claimed:
    """A feature that a drive says is somewhere.

    Attributes:
        feature_id: that it will have should nobody have found it before.
        kind: of it.
        place: in the frame of the tile that is merged.
        existence: masses of this drive alone.
        hits: looks that detected it.
        attributes: of it.
        is_found: found anew; False: measured as a map feature that stands elsewhere.
    """

    feature_id: int
    kind: str
    place: PlaceEstimate
    existence: Existence
    hits: int
    attributes: Attributes
    is_found: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Statement:
    """What one report says.

    Attributes:
        report_id: orders the statements.
        vehicle: whose.
        base_sha: of the version that it was compared with, b"" without one; None: of this very tile it says nothing.
        viewed: mask of cells, see `FeatureChange`.
        seen: verdicts on map features.
        found: new features in this tile, and in its neighbours near it.
    """

    report_id: str
    vehicle: str
    base_sha: bytes | None
    viewed: int
    seen: tuple[Seen, ...]
    found: tuple[Claimed, ...]


def statements_of(tile: TileId, reports: Iterable[FeatureReport], reach_m: float) -> tuple[Statement, ...]:
    """The statements about one tile, sorted by report id.

    Args:
        tile: that is merged.
        reports: in any order; parts of one report may come apart (they have one id); what comes again is ignored.
        reach_m: how far outside the tile what was found may lie.
    """
    parts: dict[str, dict[TileId, FeatureChange]] = {}
    vehicles: dict[str, str] = {}
    near = {tile, *around(tile)}
    for report in sorted(reports, key=lambda report: report.report_id):
        vehicles.setdefault(report.report_id, report.vehicle)
        changes = parts.setdefault(report.report_id, {})
        for change in report.tiles:
            if change.tile in near:
                changes.setdefault(change.tile, change)
    statements = [_statement(tile, key, vehicles[key], changes, reach_m) for key, changes in parts.items()]
    return tuple(one for one in statements if one.base_sha is not None or one.found)


def _statement(
    tile: TileId, report_id: str, vehicle: str, changes: Mapping[TileId, FeatureChange], reach_m: float
) -> Statement:
    own = changes.get(tile)
    found: list[Claimed] = []
    for source in sorted(changes):
        found += _claims(tile, report_id, changes[source], reach_m)
    if own is None:
        return Statement(report_id, vehicle, None, 0, (), tuple(found))
    return Statement(report_id, vehicle, own.base_sha, own.viewed, own.seen, tuple(found))


def _claims(tile: TileId, report_id: str, change: FeatureChange, reach_m: float) -> list[Claimed]:
    own = change.tile == tile
    found = [one for one in change.found if own or near_border(tile, change.tile, one, reach_m)]
    names: set[int] = set()
    claims = []
    for one in found:
        name = _name(report_id, change.tile, one, names)
        place = PlaceEstimate.of(_moved(tile, change.tile, one.points_m), one.cov_m2)
        claims.append(Claimed(name, one.kind, place, one.existence, one.hits, one.attributes))
    return claims


def _name(report_id: str, source: TileId, found: Found, taken: set[int]) -> int:
    """The same id in whichever tile it is merged: it comes from what was sent, and from how often that was sent."""
    content = found.kind, np.ascontiguousarray(found.points_m, "<f8").tobytes()
    name = feature_id_of(report_id, source.morton, *content)
    while name in taken:
        name = feature_id_of(name, "again")
    taken.add(name)
    return name


def _moved(tile: TileId, source: TileId, points_m: F64) -> F64:
    """(N, 3) in the frame of `tile`; frames of neighbours differ in direction by less than 10 µrad."""
    if tile == source:
        return points_m
    T_tile_source = between(tile, source)
    return np.asarray(points_m @ T_tile_source[:3, :3].T + T_tile_source[:3, 3])


def contents_of(bases: Mapping[bytes, Sequence[Feature]]) -> dict[bytes, dict[int, tuple[Feature, ...]]]:
    """Versions by hash, and in each the features by id (a polyline may have several pieces in a tile)."""
    found: dict[bytes, dict[int, tuple[Feature, ...]]] = {}
    for sha, features in bases.items():
        of_id = found.setdefault(sha, {})
        for feature in features:
            of_id[feature.feature_id] = (*of_id.get(feature.feature_id, ()), feature)
    return found
