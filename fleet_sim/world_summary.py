"""What a world holds, in figures: place, objects, and its edits by kind and by place along the street."""

from collections import Counter
from collections.abc import Iterable, Mapping
from math import degrees
from typing import Final

import numpy as np

from gnd.fleet_sim.street_site import x_of
from gnd.fleet_sim.world import EDITS, STATES, World
from gnd.gnd_map.tile_id import TileId

PLACE_M: Final = 50.0
"""Length of the stretches by which edits are counted."""


def summary(world: World) -> dict[str, object]:
    """Return the figures of a world that `gnd sim world inspect` prints, ready for JSON.

    A thing that was moved or reshaped counts once, where it stood before.
    """
    kinds, edited = Counter(o.kind for o in world.objects), _edited(world)
    count = Counter(edit for edit, _, _ in edited)
    return {
        "seed": world.seed,
        "family": world.family,
        "anchor": {"lat_deg": degrees(world.lat_rad), "lon_deg": degrees(world.lon_rad), "height_m": world.height_m},
        "districts": districts(world),
        "heading_deg": round(degrees(world.heading_rad), 3),
        "slope": round(world.slope, 5),
        "parking": {"share": world.parking, "kerb": world.kerb_parking, "bays": len(world.bays)},
        "length_m": 2 * world.half_length_m,
        "shapes": {state: len(world.shapes(state)) for state in STATES},
        "kinds": dict(sorted(kinds.items())),
        "edits": {"kept": sum(o.edit == "kept" for o in world.objects)} | {edit: count[edit] for edit in EDITS[1:]},
        "edits_by_kind": {e: _counts(kind for edit, kind, _ in edited if edit == e) for e in EDITS[1:]},
        "edits_by_place": edits_by_place(world),
    }


def edits_by_place(world: World) -> dict[str, dict[str, int]]:
    """Return the number of edits of each sort on every 50 m of street, by "from … to" in metres along it."""
    places = np.arange(-world.half_length_m, world.half_length_m, PLACE_M).tolist()
    found: dict[str, dict[str, int]] = {}
    for x0 in places:
        x1 = min(x0 + PLACE_M, world.half_length_m)
        found[f"{x0:+g} … {x1:+g}"] = _counts(edit for edit, _, x in _edited(world) if x0 <= x < x1)
    return found


def districts(world: World) -> list[str]:
    """Return the districts in which the middle of the street lies, sorted."""
    x = np.linspace(-world.half_length_m, world.half_length_m, 101)
    lat, lon, _ = world.frame.geodetic_from_enu(world.map_of_street(np.outer(x, [1.0, 0.0, 0.0])))
    return sorted({TileId.from_geodetic(a, b).district.path for a, b in zip(lat.tolist(), lon.tolist(), strict=True)})


def _edited(world: World) -> list[tuple[str, str, float]]:
    """Sort of edit, kind of thing and place along the street of everything that was edited, each thing once."""
    first = {(o.name, o.edit): o for o in reversed(world.objects) if o.edit != "kept"}
    return [(o.edit, o.kind, x_of(o)) for o in reversed(first.values())]


def _counts(values: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(values).items()))


def as_text(found: Mapping[str, object]) -> str:
    """Return a summary as lines for people."""
    lines: list[str] = []
    for name, value in found.items():
        if isinstance(value, dict) and any(isinstance(row, dict) for row in value.values()):
            lines += [f"{name}:", *(f"  {key:<14} {_short(row)}" for key, row in value.items())]
        else:
            lines.append(f"{name:<16} {_short(value)}")
    return "\n".join(lines)


def _short(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {number}" for key, number in value.items()) or "-"
    return ", ".join(value) if isinstance(value, list) else str(value)
