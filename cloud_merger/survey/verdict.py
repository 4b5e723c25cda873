"""What a tile of a new road becomes: draft, waiting with its reason, or published."""

from typing import Final

from gnd.cloud_merger.survey.fuse import LEAST_SHARED, FusedTile
from gnd.tile_store.roads import RoadState

MIN_VEHICLES: Final = 2
"""So many vehicles must have driven there."""
MOST_SIGMA_M: Final = 0.12
"""Position sigma of the submaps, the largest."""
MOST_APART_M: Final = 0.12
"""90 % of the voxels that vehicles share lie nearer together."""
LEAST_AGREED: Final = 0.5
"""Share of the shared voxels in which vehicles must agree."""


def verdict(one: FusedTile, left_out: str = "") -> tuple[RoadState, str]:
    """How far a tile is, and why no farther; "" once it may be published.

    Args:
        one: the tile.
        left_out: what is to be told of drives that are not believed.
    """
    told = f"; {left_out}" if left_out else ""
    if len(one.vehicles) < MIN_VEHICLES:
        return "draft", f"{len(one.vehicles)} of {MIN_VEHICLES} vehicles{told}"
    if one.apart_m is None:
        return "waiting", f"{one.shared} shared voxels, {LEAST_SHARED} are needed{told}"
    if one.sigma_m > MOST_SIGMA_M:
        return "waiting", f"its place is known to {one.sigma_m:.2f} m, {MOST_SIGMA_M:g} m are needed{told}"
    agreed = int(one.agreed.sum())
    if one.apart_m > MOST_APART_M or agreed < LEAST_AGREED * one.shared:
        apart = f"vehicles lie {one.apart_m:.2f} m apart (90 % of {one.shared} voxels)"
        return "waiting", f"{apart}, {MOST_APART_M:g} m are allowed{told}"
    return "published", left_out
