"""Where false changes lie: by distance from the track, by the angle at which rays meet the surface, by number of rays.

Only what both halves looked at is counted here (`rounds.looked_at`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.gnd_map.classes import CHANGED, ChangeClass
from studies.frame.tables import Sheet, fixed, sheet
from studies.real.drive import FoundVoxels
from studies.real.rounds import Round

F64 = NDArray[np.float64]
CHANGE_NAMES: Final = {c: c.name.lower() for c in CHANGED}
DISTANCES_M: Final = {"0-10 m": (0.0, 10.0), "10-25 m": (10.0, 25.0), "25-50 m": (25.0, np.inf)}
ANGLES_DEG: Final = {"0-10°": (0.0, 10.0), "10-30°": (10.0, 30.0), "30-90°": (30.0, np.inf)}
RAYS: Final = {"under 30": (0.0, 30.0), "30-100": (30.0, 100.0), "over 100": (100.0, np.inf)}
NO_PLANE: Final = "no plane"
_TITLES: Final = {
    "distance_m": "from the track",
    "angle_deg": "between ray and surface",
    "rays": "rays that ended in it or passed it",
}


def distance_m(from_m: F64, points_m: F64) -> F64:
    """(K,) distance of points (K, 3) from the nearest of the places (S, 3) that the LiDAR drove through."""
    return np.asarray(cKDTree(from_m).query(points_m)[0], np.float64).reshape(len(points_m))


def angles_deg(from_m: F64, found: FoundVoxels) -> F64:
    """(K,) angle between the surface and the ray from the nearest place of the LiDAR, 0 grazing; NaN: no plane."""
    ray = found.surface_m - from_m[cKDTree(from_m).query(found.surface_m)[1].reshape(len(found.keys))]
    sine = np.abs(np.einsum("ni,ni->n", ray, found.normal)) / np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    return np.where(found.normal.any(axis=1), np.rad2deg(np.arcsin(np.minimum(sine, 1.0))), np.nan)


def inside(values: F64, span: tuple[float, float]) -> NDArray[np.bool_]:
    """(K,) whether values lie in a band, its end not included."""
    return np.asarray((values >= span[0]) & (values < span[1]))


def bands_of(rounds: Sequence[Round]) -> dict[str, dict[str, dict[str, int]]]:
    """How many Gaussians of each band were observed by both halves, and how many of them changed, by class."""
    counts: dict[str, dict[str, dict[str, int]]] = {name: {} for name in _TITLES}
    for r in rounds:
        seen = r.untouched.found.within(r.untouched.seen)
        holds = (seen.in_map & (seen.change_class != ChangeClass.UNMEASURED)) | seen.where(ChangeClass.NEW)
        found = seen.take(np.asarray(holds))
        for name, bands in _members(r, found).items():
            for band, member in bands.items():
                row = counts[name].setdefault(band, dict.fromkeys(("gaussians", *CHANGE_NAMES.values()), 0))
                row["gaussians"] += int(member.sum())
                for change, label in CHANGE_NAMES.items():
                    row[label] += int((member & found.where(change)).sum())
    return counts


def _members(one: Round, found: FoundVoxels) -> dict[str, dict[str, NDArray[np.bool_]]]:
    """Which of the voxels lie in which band."""
    from_m = one.untouched.driven_from_m
    far_m, angle, rays = distance_m(from_m, found.surface_m), angles_deg(from_m, found), found.hits + found.passes
    return {
        "distance_m": {name: inside(far_m, span) for name, span in DISTANCES_M.items()},
        "angle_deg": {name: inside(angle, span) for name, span in ANGLES_DEG.items()} | {NO_PLANE: np.isnan(angle)},
        "rays": {name: inside(rays.astype(np.float64), span) for name, span in RAYS.items()},
    }


def bands_sheet(found: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Sheet:
    """The counts as a table."""
    columns = ("", "", "Gaussians", *CHANGE_NAMES.values(), "deleted a 1,000")
    table = sheet("Observed in both halves, nothing changed: reported nevertheless", *columns)
    table.texts = ("",)
    for name, title in _TITLES.items():
        for number, (band, row) in enumerate(found[name].items()):
            rate = 1000.0 * row["deleted"] / row["gaussians"] if row["gaussians"] else None
            changes = (f"{row[label]:,}" for label in CHANGE_NAMES.values())
            table.add("" if number else title, band, f"{row['gaussians']:,}", *changes, fixed(rate))
    return table


def inserted_sheet(inserted: Mapping[str, Any]) -> Sheet:
    """What became of the inserted objects, by distance."""
    table = sheet(
        "Objects inserted, by distance from the track", "", "", "voxels", "found", "recall", "false", "precision"
    )
    table.texts = ("",)
    for name in ("new", "deleted"):
        for number, (band, row) in enumerate(inserted[name]["by_distance"].items()):
            recall, precision = ("–" if row[key] is None else f"{row[key]:.1%}" for key in ("recall", "precision"))
            counts = str(row["true"]), str(row["found"]), recall, str(row["false"]), precision
            table.add("" if number else name, band, *counts)
    return table
