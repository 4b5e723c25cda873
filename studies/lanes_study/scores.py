"""A layer of borders against the truth of its street, and edits of a map against what was truly changed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from gnd.deploy.lane_edits import MapEdits, painted
from gnd.fleet_sim.markings import FloatArray, Paint, PaintedBorder
from gnd.fleet_sim.world import State
from gnd.gnd_map.features import Feature, geodetic_in_tile
from gnd.gnd_map.features.lane_pieces import LanePiece, beside, lane_pieces, left_of
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.feature_io.values import FeatureFile

TOLERANCE_M: Final = 0.15
_MARGIN_M: Final = 10.0
"""At the ends of the stretch that is driven nobody looks long enough."""
_END_M: Final = 5.0
_SHIFT_ERROR_M: Final = 0.2
"""Of a border that was moved: the HD map itself is off by some centimetres."""

Layer = Mapping[TileId, Sequence[Feature]]


@dataclass(frozen=True, slots=True, eq=False)
class LaneScore:
    """A layer against the truth.

    Attributes:
        counts: true pieces, those found, published pieces, those that are true, of these with a type, type right.
        errors_m: (K,) across, of the matched ones, signed.
        nees: (K,) squared errors over claimed variances, one degree of freedom.
    """

    counts: Mapping[str, int]
    errors_m: FloatArray
    nees: FloatArray


def score_layer(paint: Paint, state: State, layer: Layer) -> LaneScore:
    """Score what is published against the paint of a state."""
    truth = _true_pieces(paint, state)
    shown = [(tile, one) for tile, some in layer.items() for one in some if _is_driven(paint, tile, one.points_m)]
    shown = [row for row in shown if _nearest(truth, *row)[0] is not None or not _is_at_end(paint, state, *row)]
    matched: dict[int, int] = {}
    errors, nees, types = [], [], Counter[str]()
    for k, (tile, one) in enumerate(shown):
        best, off = _nearest(truth, tile, one)
        if best is None or best in matched.values():
            continue
        matched[k] = best
        left = left_of(one.points_m)[:2]
        xx, xy, _, yy, _, _ = one.cov_m2
        errors.append(off)
        nees.append(off**2 / float(left @ np.array([[xx, xy], [xy, yy]]) @ left))
        said = dict(one.attributes).get("subtype")
        types["typed"] += said is not None
        types["right"] += said == truth[best][1].marking
    counts = {"true": len(truth), "found": len(matched), "published": len(shown), **types}
    return LaneScore(counts, np.array(errors), np.array(nees))


def _true_pieces(paint: Paint, state: State) -> list[tuple[LanePiece, PaintedBorder]]:
    pieces = []
    for border in _joined(paint.borders(state)):
        line = paint.line_map_m(border, 5.0)
        cut = lane_pieces(*paint.world.frame.geodetic_from_enu(line))
        pieces += [(piece, border) for piece in cut if _is_driven(paint, piece.tile, piece.points_m)]
    return pieces


def _joined(borders: Sequence[PaintedBorder]) -> list[PaintedBorder]:
    """Borders that go on alike as one: paint does not end where a map's way does."""
    lines: list[PaintedBorder] = []
    for one in sorted(borders, key=lambda one: (one.line, one.start_m)):
        last = lines[-1] if lines else None
        if last and (last.line, last.y_m, last.marking, last.end_m) == (one.line, one.y_m, one.marking, one.start_m):
            lines[-1] = replace(last, end_m=one.end_m)
        else:
            lines.append(one)
    return lines


def _is_at_end(paint: Paint, state: State, tile: TileId, one: Feature) -> bool:
    """Whether a piece lies where paint begins or ends: half of it is right, and it counts for nothing."""
    middle = paint.world.frame.enu_from_geodetic(*geodetic_in_tile(tile, one.points_m.mean(axis=0)[None]))
    x, y, _ = paint.world.street_of_map(np.atleast_2d(middle))[0]
    ends = ((end, border.y_m) for border in _joined(paint.borders(state)) for end in (border.start_m, border.end_m))
    return any(abs(x - end) < _END_M and abs(y - across) < TOLERANCE_M for end, across in ends)


def _is_driven(paint: Paint, tile: TileId, points_m: FloatArray) -> bool:
    middle = paint.world.frame.enu_from_geodetic(*geodetic_in_tile(tile, points_m.mean(axis=0)[None]))
    x = float(paint.world.street_of_map(np.atleast_2d(middle))[0, 0])
    return abs(x) < paint.world.half_length_m - _MARGIN_M


def _nearest(truth: Sequence[tuple[LanePiece, PaintedBorder]], tile: TileId, one: Feature) -> tuple[int | None, float]:
    best, off = None, TOLERANCE_M
    for k, (piece, _) in enumerate(truth):
        if piece.tile != tile:
            continue
        overlap, left_m = beside(piece.points_m, one.points_m)
        if overlap >= 0.5 and abs(left_m) < abs(off):
            best, off = k, left_m
    return best, off


def told(score: Sequence[LaneScore]) -> dict[str, Any]:
    """Figures of several streets together."""
    n = sum((Counter(one.counts) for one in score), Counter[str]())
    errors = np.abs(np.concatenate([one.errors_m for one in score]))
    nees = np.concatenate([one.nees for one in score])
    return {
        "recall": _share(n["found"], n["true"]),
        "precision": _share(n["found"], n["published"]),
        "type_right": _share(n["right"], n["typed"]),
        "lateral_m_p50": _quantile(errors, 0.5),
        "lateral_m_p95": _quantile(errors, 0.95),
        "nees": round(float(nees.mean()), 2) if len(nees) else None,
        "pieces": n["true"],
    }


def _share(some: int, every: int) -> float | None:
    return round(some / every, 4) if every else None


def _quantile(values: FloatArray, share: float) -> float | None:
    return round(float(np.quantile(values, share)), 4) if len(values) else None


def score_edits(paint: Paint, file: FeatureFile, edits: MapEdits) -> dict[str, Any]:
    """How many true changes were told as the right edit, and which edits are of nothing that changed.

    A border is looked at where most of it lies in the stretch that is driven.
    """
    truth = {one.feature_id: border for one, border in zip(painted(file.features), paint.before, strict=True)}
    changed = {name: one for name, one in truth.items() if one.edit != "kept" and _is_looked_at(paint, one)}
    right: list[str] = []
    wrong: list[str] = []
    partly = 0
    for edit in edits.edits:
        border = truth.get(edit.feature_id)
        if edit.what == "added":
            is_right = any(_is_of_site(paint, one, edit.lat_deg, edit.lon_deg) for one in paint.after)
        elif edit.what in ("partly_removed", "unclear"):
            partly += 1
            continue
        else:
            is_right = border is not None and _fits(paint, border, edit.what, edit.shift_m)
        (right if is_right else wrong).append(f"{edit.what} {border.name if border else ''}".strip())
    sites = sum(one.edit == "added" for one in paint.after)
    kept_km = sum(one.end_m - one.start_m for one in truth.values() if one.edit == "kept") * 1e-3
    found = {edit.feature_id for edit in edits.edits if edit.feature_id in changed} & _named(edits, truth, right)
    added = min(sites, sum(one.startswith("added") for one in right))
    return {
        "changes": len(changed) + sites,
        "found": len(found) + added,
        "edits": len(right) + len(wrong),
        "right": len(right),
        "wrong": wrong,
        "partly": partly,
        "missed": sorted(f"{one.edit} {one.name}" for name, one in changed.items() if name not in found),
        "kept_km": round(kept_km, 3),
    }


def _named(edits: MapEdits, truth: Mapping[int, PaintedBorder], right: Sequence[str]) -> set[int]:
    names = {one.split(" ", 1)[1] for one in right if " " in one}
    return {
        edit.feature_id for edit in edits.edits if edit.feature_id in truth and truth[edit.feature_id].name in names
    }


def _is_looked_at(paint: Paint, one: PaintedBorder) -> bool:
    reach = paint.world.half_length_m - _MARGIN_M
    inside = min(one.end_m, reach) - max(one.start_m, -reach)
    return inside > 0.7 * (one.end_m - one.start_m)


def _fits(paint: Paint, border: PaintedBorder, what: str, shift_m: float) -> bool:
    if border.edit == "shifted":
        after = next(one for one in paint.after if one.name == border.name)
        return what == "moved" and abs(shift_m - (after.y_m - border.y_m)) < _SHIFT_ERROR_M
    return what in {"removed": ("removed", "virtual"), "retyped": ("retyped",), "kept": ()}.get(border.edit, ())


def _is_of_site(paint: Paint, one: PaintedBorder, lat_deg: float, lon_deg: float) -> bool:
    """Whether a new border begins beside the yellow paint of a site."""
    if one.edit != "added":
        return False
    height = np.array([paint.world.height_m])
    place = paint.world.frame.enu_from_geodetic(np.radians([lat_deg]), np.radians([lon_deg]), height)
    x, y, _ = paint.world.street_of_map(np.atleast_2d(place))[0]
    return bool(one.start_m - 6.0 < x < one.end_m + 6.0 and abs(y - one.y_m) < 0.3)
