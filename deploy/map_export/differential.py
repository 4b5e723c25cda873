"""What Autoware's GetDifferentialPointCloudMap asks for: which cells of an area a client lacks, and which it drops.

A client names the cells that it has by their ids, the names of their files. Those change with the content: a client
whose cells have changed names them by their old names, gets the new ones and is told to drop the old.
"""

import math
from collections.abc import Iterable, Mapping
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

    def distance_m(self, corner: tuple[int, int]) -> float:
        """How far the nearest point of a cell lies from the centre, m."""
        off = [
            max(low - centre, 0.0, centre - (low + CELL_M))
            for low, centre in zip(corner, (self.center_x, self.center_y), strict=True)
        ]
        return math.hypot(*off)


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
    inside = cells_in(read_metadata(folder), area)
    cached = set(cached_ids)
    return Difference(
        new={name: folder / CLOUDS / name for name in inside if name not in cached},
        ids_to_remove=tuple(sorted(cached.difference(inside))),
    )


def cells_in(corners: Mapping[str, tuple[int, int]], area: Area) -> list[str]:
    """The ids of the cells that have a point in common with the circle, the nearest to its centre first."""
    far_m = {name: area.distance_m(corner) for name, corner in corners.items()}
    return sorted((name for name in far_m if far_m[name] <= area.radius), key=lambda name: (far_m[name], name))
