"""A SLAM track of 4 km and its Lanelet2 map onto the Earth by GNSS without times: a real drive in Garching.

What the GNSS says is held out in turns: of each 200 m of its way the second half is left out of the graph, and how far
these fixes lie from the track is told (the nearest place within 15 m along, so it is the distance across). The
lanes are an independent witness: drawn in the SLAM's frame, they are moved with the track's nearest pose, and the GNSS
fixes, which the drawer of lanes never used, should lie in them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmRelation, read_osm
from gnd.vehicle_agent.localise.drawn_map import read_fixes, read_track
from gnd.vehicle_agent.localise.georeference import Georeferenced, georeference
from gnd.vehicle_agent.localise.path_association import georeference_untimed, nearest_on_track, way_m
from gnd.vehicle_agent.localise.track_alignment import FixTable
from studies.frame.errors import RealDataError

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

HELD_OUT_M: Final = 100.0
NEAR_M: Final = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class FlexmapLane:
    """Left and right border, (N, 3) and (M, 3) in the SLAM's frame."""

    left_m: F64
    right_m: F64


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFlexmap:
    """What a picture needs: the rigid and the bent track, the fixes (held out: (N,) bool), the lanes' outlines."""

    rigid: Georeferenced
    bent: Georeferenced
    fixes: FixTable
    held_out: NDArray[np.bool_]
    lanes: tuple[F64, ...]


def is_flexmap(folder: Path) -> bool:
    """Whether a folder holds such a recording."""
    return all(len(list(folder.glob(name))) == 1 for name in ("*_pose_kitti.txt", "*_GPS.txt", "lanelet2_*.osm"))


def flexmap_of(folder: Path) -> tuple[dict[str, Any], DrawnFlexmap]:
    """Residuals and lanes, and what a picture needs.

    Raises:
        GndError: a file that cannot be read, or has no lanelets.
    """
    track = read_track(next(folder.glob("*_pose_kitti.txt")))
    fixes = read_fixes(next(folder.glob("*_GPS.txt")))
    everything, table = georeference_untimed(track, fixes)
    held_out = (way_m(table.enu_m(everything.frame)) // HELD_OUT_M).astype(np.int64) % 2 == 1
    kept = table.take(np.flatnonzero(~held_out))
    rigid, bent = (georeference(track, kept, drift=drift) for drift in (False, True))
    lanes = _lanes(folder)
    outlines = {name: _outlines(lanes, track, found) for name, found in (("rigid", rigid), ("bent", bent))}
    p = {name: table.enu_m(found.frame) for name, found in (("rigid", rigid), ("bent", bent))}
    result = {
        "poses": len(track),
        "way_m": float(way_m(track.T_dst_vehicle[:, :3, 3])[-1]),
        "fixes": len(fixes),
        "moving_fixes": len(table),
        "held_out": int(held_out.sum()),
        "disbelieved": float((bent.weights < 0.25).mean()),
        "held_out_m": {name: _off(found, table, held_out) for name, found in (("rigid", rigid), ("bent", bent))},
        "used_m": {name: _off(found, table, ~held_out) for name, found in (("rigid", rigid), ("bent", bent))},
        "lanes": len(lanes),
        "track_in_lanes": _inside(_outlines(lanes, track, None), track.T_dst_vehicle[:, :3, 3]),
        "held_out_in_lanes": {name: _inside(outlines[name], p[name][held_out]) for name in p},
        "origin": _origin(bent),
    }
    return result, DrawnFlexmap(rigid, bent, table, held_out, tuple(outlines["bent"]))


def _origin(found: Georeferenced) -> dict[str, float]:
    lat, lon, _, heading = found.geodetic()
    values = np.degrees([lat[0], lon[0], heading[0]])
    return dict(zip(("lat_deg", "lon_deg", "heading_deg"), map(float, values), strict=True))


def _off(found: Georeferenced, fixes: FixTable, chosen: NDArray[np.bool_]) -> dict[str, float]:
    """Metres of fixes from the nearest place of the track."""
    some = fixes.take(np.flatnonzero(chosen))
    track_m = found.track.T_dst_vehicle[:, :3, 3]
    way = way_m(track_m)
    at = np.interp(some.t_ns - found.track.t_ns[0], found.track.t_ns - found.track.t_ns[0], way)
    p = some.enu_m(found.frame)
    near = nearest_on_track(track_m, way, p, at, NEAR_M)
    on_track = np.column_stack([np.interp(near, way, track_m[:, axis]) for axis in (0, 1)])
    off = np.linalg.norm(p[:, :2] - on_track, axis=1)
    return {"p50": float(np.median(off)), "p95": float(np.quantile(off, 0.95)), "max": float(off.max())}


# --- files -----------------------------------------------------------------------------------------------------------


def _lanes(folder: Path) -> list[FlexmapLane]:
    """The lanelets; their nodes carry local coordinates (their latitudes are placeholders)."""
    path = next(folder.glob("lanelet2_*.osm"))
    document = read_osm(path.read_bytes(), path.name)
    lanelets = [one for one in document.relations.values() if one.tags.get("type") == "lanelet"]
    if not lanelets:
        raise RealDataError(f"{path}: no lanelets")
    return [FlexmapLane(*(_border_m(document, one, side) for side in ("left", "right"))) for one in lanelets]


def _border_m(document: OsmDocument, lanelet: OsmRelation, side: str) -> F64:
    nodes = document.nodes_of(document.ways[lanelet.member("way", side)[0]])
    return np.array([[float(node.tags[key]) for key in ("local_x", "local_y", "ele")] for node in nodes])


def _outlines(lanes: list[FlexmapLane], track: Trajectory, found: Georeferenced | None) -> list[F64]:
    """(K, 2) outline of each lane, moved with the track's nearest pose, or as drawn."""
    outlines = []
    for lane in lanes:
        right = lane.right_m if _same_way(lane) else lane.right_m[::-1]
        outline = np.concatenate([lane.left_m, right[::-1]])
        outlines.append((outline if found is None else _moved(outline, track, found))[:, :2])
    return outlines


def _same_way(lane: FlexmapLane) -> bool:
    """Whether both borders are drawn in the same direction."""
    straight = np.linalg.norm(lane.left_m[0] - lane.right_m[0]) + np.linalg.norm(lane.left_m[-1] - lane.right_m[-1])
    crossed = np.linalg.norm(lane.left_m[0] - lane.right_m[-1]) + np.linalg.norm(lane.left_m[-1] - lane.right_m[0])
    return bool(straight <= crossed)


def _moved(p_local_m: F64, track: Trajectory, found: Georeferenced) -> F64:
    """Points of the SLAM's frame, each moved as the pose nearest to it was."""
    apart = np.linalg.norm(p_local_m[:, None, :2] - track.T_dst_vehicle[None, :, :2, 3], axis=2)
    moved = found.track.T_dst_vehicle @ T_inverse(track.T_dst_vehicle)
    return np.concatenate([transform(moved[i], p[None]) for i, p in zip(apart.argmin(axis=1), p_local_m, strict=True)])


def _inside(outlines: list[F64], p_m: F64) -> float:
    """Share of points (N, 3) in any of the lanes."""
    inside = np.zeros(len(p_m), np.bool_)
    for outline in outlines:
        inside |= Outline(outline).contains_points(p_m[:, :2])
    return float(inside.mean())
