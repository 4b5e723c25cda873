"""`gnd map align` where one of the two is a vector HD map: its posts on those of a LiDAR map or a drive."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.map_align.align_posts import PostAlignment, align_posts
from gnd.vehicle_agent.map_align.candidates import Reach
from gnd.vehicle_agent.map_align.cloud import cloud_of_tiles
from gnd.vehicle_agent.map_align.move import moved_drive, write_moved
from gnd.vehicle_agent.map_align.posts import features_of, is_vector_map, posts_of_cloud, posts_of_features
from gnd.vehicle_agent.map_align.sources import AlignError, Side, frame_of, open_side


@dataclass(frozen=True, slots=True, eq=False)
class VectorAlignment:
    """What was found, and of what.

    side: the LiDAR map. stays: whether the HD map is A.
    """

    a: Path
    b: Path
    side: Side
    frame: LocalFrame
    found: PostAlignment
    stays: bool

    @property
    def T_a_b(self) -> F64:
        """(4, 4) moves B onto A in the frame."""
        return self.found.T_vector_lidar if self.stays else self.found.T_lidar_vector

    def as_dict(self) -> dict[str, Any]:
        """For JSON; the shift is B's, at the middle of the HD map's posts."""
        pivot = np.append(self.found.pivot_m, 0.0)
        shift = transform(self.T_a_b, pivot[None])[0] - pivot
        about = {"a": str(self.a), "b": str(self.b)}
        about_frame = {"frame": {"lat_rad": self.frame.lat_rad, "lon_rad": self.frame.lon_rad}}
        turn = float(np.degrees(np.arctan2(self.T_a_b[1, 0], self.T_a_b[0, 0])))
        own = {"shift_m": {"east": float(shift[0]), "north": float(shift[1])}, "T_a_b": self.T_a_b.tolist()}
        return about | about_frame | self.found.as_dict() | own | {"heading_deg": turn}

    def write(self, out: Path, codec: str, layer: str) -> Path:
        """B moved onto A.

        Raises:
            AlignError: B is the HD map.
            DriveError, StoreError: it cannot be written.
        """
        if self.side.kind == "drive":
            moved_drive(self.b, out, self.frame, self.T_a_b, f"moved onto {self.a.name} by gnd map align")
        else:
            write_moved(self.side, out, self.frame, self.T_a_b, codec, layer)
        return out


def align_vector(
    a: Path, b: Path, layer: str, reach: Reach, progress: Callable[[str, int, int], None], *, writes: bool = False
) -> VectorAlignment:
    """Lay one of two onto the other, one of which is an HD map.

    writes: B is to be written.

    Raises:
        AlignError: both are HD maps, or B is one and is to be written, or one holds no posts.
        FeatureFileError, BuildError, DriveError, StoreError: one cannot be read or built.
    """
    stays = is_vector_map(a)
    if stays and is_vector_map(b):
        raise AlignError(f"{a} and {b} are both HD maps; one of the two is a LiDAR map or a drive")
    if writes and not stays:
        raise AlignError(f"{b} is an HD map, which --out does not move: name it first, then the drive is moved onto it")
    features = features_of(a if stays else b)
    side = open_side(b if stays else a, layer, progress)
    frame = frame_of(side)
    cloud = cloud_of_tiles(side.tiles, frame)
    found = align_posts(posts_of_cloud(cloud), cloud.mean_m[:, :2], posts_of_features(features, frame), reach)
    return VectorAlignment(a, b, side, frame, found, stays)
