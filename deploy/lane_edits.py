"""What the layer of lane markings says of a Lanelet2 map: borders that moved, went, came, or are painted differently.

The map's painted borders are cut into the pieces of the grid and are the layer's first version; from then on vehicles
confirm and deny them, and find others. What has become of a border is read from its pieces: each is in its place, lies
elsewhere, is replaced by a new one beside it, or is gone. A border is edited only when most of its pieces agree.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of, geodetic_in_tile, snapped
from gnd.gnd_map.features.lane_pieces import LANE_CELLS, LanePiece, beside, lane_pieces, left_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId, tile_coordinates
from gnd.tile_store.feature_io.lanelet2_export import write_lanelet2
from gnd.tile_store.feature_io.osm_change import OsmChange, osm_change
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions, MapFeature

KIND: Final = "lane_marking"
PAINTED: Final = ("line_thin", "line_thick")
LEAST_MOVE_M: Final = 0.2
"""HD maps are within 10 to 20 cm: what lies nearer is where the map has it."""
_FARTHEST_M: Final = 1.5
_MOST: Final = 0.6
_LEAST_RUN: Final = 2
_LEAST_NEW_M: Final = 10.0
_LINK_M: Final = 0.5

Layer = Mapping[TileId, Sequence[Feature]]


@dataclass(frozen=True, slots=True)
class LaneEdit:
    """One edit of a map.

    Attributes:
        what: moved, retyped, removed, virtual (the paint is gone, a lanelet keeps the border), added; and what is told
            and not written: partly_removed, and unclear (a new border so near to one that nobody has denied enough).
        border: the way's name in the file; of an added one "".
        feature_id: of the border.
        shift_m: median shift to the left of the way's direction, of what moved.
        subtype: as it is painted now, where that is new.
        color: yellow beside works.
        length_m: of the pieces that say so.
        pieces: how many, and of how many.
        sigma_m: of the place of one of them, median.
        lat_deg, lon_deg: the middle of the first.
    """

    what: str
    border: str
    feature_id: int
    shift_m: float
    subtype: str
    color: str
    length_m: float
    pieces: tuple[int, int]
    sigma_m: float
    lat_deg: float
    lon_deg: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class MapEdits:
    """The edits of a map.

    Attributes:
        edits: for people, in the order of the file.
        edited: the whole map after them.
        change: what turns the one into the other.
        borders: painted borders compared, and their length.
        length_m: of all these.
    """

    edits: tuple[LaneEdit, ...]
    edited: bytes
    change: OsmChange
    borders: int
    length_m: float


def painted(features: Iterable[MapFeature]) -> list[MapFeature]:
    """The painted borders among the features of a map."""
    return [
        one
        for one in features
        if one.kind == "lane_boundary" and len(one) >= 2 and dict(one.attributes).get("type") in PAINTED
    ]


def piece_id(border: MapFeature, piece: LanePiece) -> int:
    """The id of a border's piece in the layer."""
    return feature_id_of(KIND, border.feature_id, *piece.cell)


def map_pieces(features: Iterable[MapFeature]) -> dict[TileId, FeatureTile]:
    """The first version of the layer: the painted borders of a map in pieces.

    Each keeps the subtype and the colour of its way; a border that comes back to a cell keeps its first piece there.
    """
    tiles: dict[TileId, dict[int, Feature]] = defaultdict(dict)
    for border in painted(features):
        told = {key: value for key, value in border.attributes if key in ("subtype", "color")}
        attributes = tuple(sorted({**told, "border": str(border.feature_id)}.items()))
        for piece in lane_pieces(border.lat_rad, border.lon_rad, border.height_m):
            name = piece_id(border, piece)
            one = Feature(name, KIND, piece.points_m, border.cov_m2, border.existence, attributes)
            tiles[piece.tile].setdefault(name, one)
    return {tile: FeatureTile.of(tile, 1, some.values()) for tile, some in sorted(tiles.items())}


@dataclass(slots=True, eq=False)
class _Now:
    """A piece of a border as the layer has it now.

    Attributes:
        piece: where the map has it.
        left_m: how far left of that it lies now; None: it is gone.
        sigma_m: of that.
        subtype, color: as it is painted now; "" where nothing is said.
        new: the new piece in its stead; None: it is the map's own, or none.
    """

    piece: LanePiece
    left_m: float | None
    sigma_m: float = 0.0
    subtype: str = ""
    color: str = ""
    new: Feature | None = None


def lane_edits(file: FeatureFile, layer: Layer, source: str, options: ImportOptions | None = None) -> MapEdits:
    """The edits of a Lanelet2 map that a layer of markings asks for.

    Args:
        file: the map as `read_lanelet2` gives it, with its document.
        layer: the features of the newest version of each tile; a tile that is not there has not been looked at.
        source: under which name the map was read: ids are made of it.
        options: with which it was read.
    """
    assert file.document is not None
    fresh: dict[int, tuple[TileId, Feature]] = {
        one.feature_id: (tile, one) for tile, some in layer.items() for one in some if _is_new(one)
    }
    bounding = {side.feature_id for lane in file.lanes for side in (lane.left, lane.right)}
    edits: list[LaneEdit] = []
    after: dict[int, MapFeature | None] = {}
    borders = painted(file.features)
    for border in borders:
        state = _states(border, layer, fresh)
        edit = _edit_of(border, state, border.feature_id in bounding)
        if edit is not None:
            edits.append(edit)
            after[border.feature_id] = _edited(border, state, edit)
        for one in state if edit is not None else ():
            if one.new is not None:
                fresh.pop(one.new.feature_id, None)
    fresh = _not_in_place(fresh, borders, after)
    fresh, unclear = _apart(fresh, layer)
    added = [_added(line) for line in _chains(fresh)]
    edits += [edit for edit, _ in added]
    edits += [replace(edit, what="unclear") for edit, _ in map(_added, _chains(unclear))]
    now = [after.get(one.feature_id, one) for one in file.features]
    kept = [one for one in now if one is not None] + [feature for _, feature in added]
    edited, _ = write_lanelet2(kept, file.document, source, options)
    length = sum(float(np.hypot(*np.diff(one.enu_m()[:, :2], axis=0).T).sum()) for one in borders)
    return MapEdits(tuple(edits), edited, osm_change(file.document, edited, source), len(borders), length)


def _is_new(one: Feature) -> bool:
    return one.kind == KIND and len(one.points_m) == 2 and "border" not in dict(one.attributes)


def _states(border: MapFeature, layer: Layer, fresh: Mapping[int, tuple[TileId, Feature]]) -> list[_Now]:
    """What has become of each piece of a border of which the layer says something; `fresh` are the new pieces by id."""
    found = []
    for piece in lane_pieces(border.lat_rad, border.lon_rad, border.height_m):
        if piece.tile not in layer:
            continue
        name = piece_id(border, piece)
        own = next((one for one in layer[piece.tile] if one.feature_id == name), None)
        found.append(_replaced(piece, _near(piece.tile, layer, fresh)) if own is None else _placed(piece, own))
    return found


def _placed(piece: LanePiece, one: Feature) -> _Now:
    _, left_m = beside(piece.points_m, one.points_m)
    return _Now(piece, left_m, _sigma_across(one))


def _near(tile: TileId, layer: Layer, fresh: Mapping[int, tuple[TileId, Feature]]) -> list[tuple[TileId, Feature]]:
    """The new pieces of a tile and of those around it that have not replaced one yet."""
    around = (tile, *tile.neighbours())
    return [(near, one) for near in around for one in layer.get(near, ()) if _is_new(one) and one.feature_id in fresh]


def _replaced(piece: LanePiece, fresh: Sequence[tuple[TileId, Feature]]) -> _Now:
    """The nearest new piece beside one that is gone."""
    best: _Now = _Now(piece, None)
    for tile, one in fresh:
        points_m = _in_tile(piece.tile, tile, one.points_m)
        overlap, left_m = beside(piece.points_m, points_m)
        if overlap < 0.5 or abs(left_m) > _FARTHEST_M or dict(one.attributes).get("color") == "yellow":
            continue
        if best.left_m is None or abs(left_m) < abs(best.left_m):
            told = dict(one.attributes)
            best = _Now(piece, left_m, _sigma_across(one), told.get("subtype", ""), told.get("color", ""), one)
    return best


def _sigma_across(one: Feature) -> float:
    left = left_of(one.points_m)[:2]
    xx, xy, _, yy, _, _ = one.cov_m2
    return float(np.sqrt(left @ np.array([[xx, xy], [xy, yy]]) @ left))


def _in_tile(tile: TileId, source: TileId, points_m: F64) -> F64:
    if tile == source:
        return points_m
    if max(abs(a - b) for a, b in zip(tile.south_west_rad, source.south_west_rad, strict=True)) > 1e-4:
        return np.full_like(points_m, 1e9)
    T = LocalFrame.of_tile(tile).T_self_other(LocalFrame.of_tile(source))
    return np.asarray(points_m @ T[:3, :3].T + T[:3, 3])


def _edit_of(border: MapFeature, state: Sequence[_Now], is_needed: bool) -> LaneEdit | None:
    """The edit that most pieces of a border ask for; None: it is as it was."""
    if not state:
        return None
    n = len(state)
    gone = [one for one in state if one.left_m is None]
    moved = [one for one in state if one.left_m is not None and abs(one.left_m) > LEAST_MOVE_M]
    subtype = dict(border.attributes).get("subtype", "")
    other = [one for one in state if one.subtype and one.subtype != subtype]
    if len(gone) > _MOST * n:
        return _told("virtual" if is_needed else "removed", border, gone, n)
    if len(moved) >= _LEAST_RUN and (len(moved) > _MOST * n or _longest_run(state, moved) >= _LEAST_RUN + 1):
        return _told("moved", border, moved, n, other if len(other) > _MOST * n else ())
    if len(other) > _MOST * n:
        return _told("retyped", border, other, n, other)
    if _longest_run(state, gone) >= _LEAST_RUN + 1:
        return _told("partly_removed", border, gone, n)
    return None


def _longest_run(state: Sequence[_Now], some: Sequence[_Now]) -> int:
    """Of pieces one after the other."""
    longest = run = 0
    chosen = {id(one) for one in some}
    for one in state:
        run = run + 1 if id(one) in chosen else 0
        longest = max(longest, run)
    return longest


def _told(what: str, border: MapFeature, some: Sequence[_Now], n: int, other: Sequence[_Now] = ()) -> LaneEdit:
    shift = [one.left_m if _is_ahead(border, one.piece) else -one.left_m for one in some if one.left_m is not None]
    subtype = Counter(one.subtype for one in other).most_common(1)
    lat, lon, _ = geodetic_in_tile(some[0].piece.tile, some[0].piece.middle_m[None])
    return LaneEdit(
        what,
        border.name.rsplit(": ", 1)[-1],
        border.feature_id,
        round(float(np.median(shift)), 3) if shift and what == "moved" else 0.0,
        subtype[0][0] if subtype else "",
        "",
        round(sum(abs(one.piece.along_m[1] - one.piece.along_m[0]) for one in some), 1),
        (len(some), n),
        round(float(np.median([one.sigma_m for one in some])), 3),
        float(np.degrees(lat[0])),
        float(np.degrees(lon[0])),
    )


def _is_ahead(border: MapFeature, piece: LanePiece) -> bool:
    """Whether the piece runs as the border does: pieces run from west to east, from south to north."""
    way = border.enu_m(LocalFrame.of_tile(piece.tile))
    middle = np.argmin(np.hypot(*(way[:, :2] - piece.middle_m[:2]).T))
    k = min(int(middle), len(way) - 2)
    return float((way[k + 1] - way[k])[:2] @ (piece.points_m[1] - piece.points_m[0])[:2]) > 0.0


def _edited(border: MapFeature, state: Sequence[_Now], edit: LaneEdit) -> MapFeature | None:
    """The border after the edit; None: it goes."""
    tags = dict(border.attributes)
    if edit.what == "removed":
        return None
    if edit.what == "virtual":
        tags.pop("subtype", None)
        tags["type"] = "virtual"
    if edit.subtype:
        tags["subtype"] = edit.subtype
    border = replace(border, attributes=tuple(sorted(tags.items())))
    return _moved(border, state) if edit.what == "moved" else border


def _moved(border: MapFeature, state: Sequence[_Now]) -> MapFeature:
    """The border where its pieces lie now; beyond those that moved it stays."""
    frame = LocalFrame(float(border.lat_rad[0]), float(border.lon_rad[0]), float(border.height_m[0]))
    line = border.enu_m(frame)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    ordered = sorted(state, key=lambda one: min(one.piece.along_m))
    at = np.array([0.5 * sum(one.piece.along_m) for one in ordered])
    shift = np.array([_shift(border, one) for one in ordered])
    ends = [end for one, s in zip(ordered, shift, strict=True) if s for end in one.piece.along_m]
    inner = [end for end in ends if not (shift != 0.0).all()]
    places = np.unique(np.round(np.concatenate([along, inner]), 3))
    places = places[(places >= 0.0) & (places <= along[-1])]
    xyz = np.column_stack([np.interp(places, along, column) for column in line.T])
    tangent = np.gradient(xyz[:, :2], axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
    xyz[:, :2] += np.interp(places, at, shift)[:, None] * normal
    lat, lon, height = frame.geodetic_from_enu(xyz)
    return replace(border, lat_rad=lat, lon_rad=lon, height_m=height)


def _shift(border: MapFeature, one: _Now) -> float:
    """To the left of the border's direction; 0 of a piece in its place."""
    if one.left_m is None or abs(one.left_m) <= LEAST_MOVE_M:
        return 0.0
    return one.left_m if _is_ahead(border, one.piece) else -one.left_m


# New borders


def _not_in_place(
    fresh: Mapping[int, tuple[TileId, Feature]],
    borders: Sequence[MapFeature],
    after: Mapping[int, MapFeature | None],
) -> dict[int, tuple[TileId, Feature]]:
    """Without those new pieces that lie where a border of the edited map is, of the same colour."""
    there: dict[tuple[int, int], list[LanePiece]] = defaultdict(list)
    for border in borders:
        now = after.get(border.feature_id, border)
        for piece in () if now is None or dict(now.attributes).get("type") == "virtual" else _pieces(now):
            there[piece.cell].append(piece)
    left = {}
    for name, (tile, one) in fresh.items():
        near = there.get(_cell(tile, one), ())
        lateral = [beside(piece.points_m, _in_tile(piece.tile, tile, one.points_m)) for piece in near]
        if not any(overlap >= 0.5 and abs(left_m) <= LEAST_MOVE_M for overlap, left_m in lateral):
            left[name] = (tile, one)
    return left


def _pieces(one: MapFeature) -> list[LanePiece]:
    return lane_pieces(one.lat_rad, one.lon_rad, one.height_m)


def _apart(
    fresh: Mapping[int, tuple[TileId, Feature]], layer: Layer
) -> tuple[dict[int, tuple[TileId, Feature]], dict[int, tuple[TileId, Feature]]]:
    """New pieces apart from borders that the map has and that are still there, and those too near to one.

    White paint less than 1.5 m beside white paint: the fleet has not yet decided which of the two there is. Yellow
    paint stands beside white.
    """
    near: dict[int, tuple[TileId, Feature]] = {}
    for name, (tile, one) in fresh.items():
        old = (other for other in layer.get(tile, ()) if "border" in dict(other.attributes))
        beside_old = (beside(other.points_m, one.points_m) for other in old)
        if _color(one) != "yellow" and any(share >= 0.5 and abs(d) < _FARTHEST_M for share, d in beside_old):
            near[name] = (tile, one)
    return {name: row for name, row in fresh.items() if name not in near}, near


def _cell(tile: TileId, one: Feature) -> tuple[int, int]:
    """The cell that a piece of the layer is of, by its middle: what moved sideways no longer ends at cells' borders."""
    lat, lon, _ = geodetic_in_tile(tile, one.points_m.mean(axis=0)[None])
    u, v = tile_coordinates(lat, lon)
    east, north = np.abs(one.points_m[1] - one.points_m[0])[:2]
    axis = 0 if east >= north else 1
    return axis, int(np.floor((u, v)[axis][0] * LANE_CELLS))


def _chains(fresh: Mapping[int, tuple[TileId, Feature]]) -> list[list[tuple[TileId, Feature]]]:
    """New pieces that follow each other, joined to lines, of those long enough to be a border."""
    if not fresh:
        return []
    frame = LocalFrame.of_tile(min(tile for tile, _ in fresh.values()))
    rows = sorted(fresh.values(), key=lambda row: (row[0], row[1].feature_id))
    ends = np.array([_points_in(frame, tile, one) for tile, one in rows])
    following: dict[int, int] = {}
    taken: set[int] = set()
    for i in range(len(rows)):
        gap = np.hypot(*(ends[:, 0, :2] - ends[i, 1, :2]).T)
        gap[[i, *taken]] = np.inf
        k = int(np.argmin(gap))
        if gap[k] < _LINK_M and _color(rows[i][1]) == _color(rows[k][1]):
            following[i] = k
            taken.add(k)
    lines = []
    for i in range(len(rows)):
        if i in taken:
            continue
        line = [i]
        while (then := following.get(line[-1])) is not None and then not in line:
            line.append(then)
        length = sum(float(np.hypot(*(ends[j, 1] - ends[j, 0])[:2])) for j in line)
        if length >= _LEAST_NEW_M:
            lines.append([rows[j] for j in line])
    return lines


def _points_in(frame: LocalFrame, tile: TileId, one: Feature) -> F64:
    T = frame.T_self_other(LocalFrame.of_tile(tile))
    return np.asarray(one.points_m @ T[:3, :3].T + T[:3, 3])


def _color(one: Feature) -> str:
    return "yellow" if dict(one.attributes).get("color") == "yellow" else ""


def _added(line: Sequence[tuple[TileId, Feature]]) -> tuple[LaneEdit, MapFeature]:
    """A new border along a chain of pieces: each vertex in the middle of the ends that meet there."""
    ends = [np.column_stack(geodetic_in_tile(tile, one.points_m)) for tile, one in line]
    meet = [0.5 * (a[1] + b[0]) for a, b in pairwise(ends)]
    places = np.array([ends[0][0], *meet, ends[-1][1]])
    said = Counter(dict(one.attributes).get("subtype", "") for _, one in line)
    subtype = next((name for name, _ in said.most_common() if name), "solid")
    color = Counter(_color(one) for _, one in line).most_common(1)[0][0]
    tags = {"type": "line_thin", "subtype": subtype} | ({"color": color, "temporary": "yes"} if color else {})
    first = snapped(line[0][1])
    feature = MapFeature(
        first.feature_id, "lane_boundary", "lanes", places[:, 0].copy(), places[:, 1].copy(), places[:, 2].copy(),
        first.cov_m2, first.existence, tuple(sorted(tags.items())), "new border",
    )  # fmt: skip
    length = float(np.hypot(*np.diff(feature.enu_m()[:, :2], axis=0).T).sum())
    sigma = round(float(np.median([_sigma_across(one) for _, one in line])), 3)
    lat_deg, lon_deg = np.degrees(places[0, :2]).tolist()
    edit = LaneEdit(
        "added", "", feature.feature_id, 0.0, subtype, color, round(length, 1), (len(line), len(line)), sigma,
        lat_deg, lon_deg,
    )  # fmt: skip
    return edit, feature
