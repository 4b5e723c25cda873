"""What Autoware's GetDifferentialPointCloudMap asks for, answered from an exported map.

`gnd map export STORE FOLDER --to autoware` again brings the folder up to date; a client whose cells have changed names
them by their old names, gets the new ones and is told to drop the old. Messages and bus are not part of this.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gnd.deploy.map_export.autoware import CELL_M, CLOUDS, read_metadata
from gnd.tile_store.export import ExportError


@dataclass(frozen=True, slots=True)
class Area:
    """A circle, as autoware_map_msgs/AreaInfo: m in the frame of the map."""

    center_x: float
    center_y: float
    radius: float

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.center_x, self.center_y, self.radius))) or self.radius < 0.0:
            raise ExportError(f"an area needs finite values and a radius of at least 0, got {self}")


@dataclass(frozen=True, slots=True)
class Difference:
    """The answer.

    Attributes:
        new: the files of the cells in the area that the client has not, by id.
        ids_to_remove: what the client has and is not in the area, or no longer in the map.
    """

    new: dict[str, Path]
    ids_to_remove: tuple[str, ...]


def differential_map(folder: Path, area: Area, cached_ids: Iterable[str]) -> Difference:
    """Compare what a client has with the cells that touch an area; the id of a cell is its file's name.

    Raises:
        ExportError: the folder holds no exported map.
    """
    inside = {name for name, corner in read_metadata(folder).items() if _touches(corner, area)}
    cached = set(cached_ids)
    return Difference(
        new={name: folder / CLOUDS / name for name in sorted(inside - cached)},
        ids_to_remove=tuple(sorted(cached - inside)),
    )


def _touches(corner: tuple[int, int], area: Area) -> bool:
    """Whether a cell and the circle have a point in common."""
    off = [
        max(low - centre, 0.0, centre - (low + CELL_M))
        for low, centre in zip(corner, (area.center_x, area.center_y), strict=True)
    ]
    return math.hypot(*off) <= area.radius
