"""Roads that the map does not have, as a store keeps them: parts of surveys, and what has become of tiles."""

from dataclasses import dataclass, field
from typing import Literal

from gnd.gnd_map.tile_id import TileId

RoadState = Literal["draft", "waiting", "published"]
"""draft: of one vehicle; waiting: several have driven there, and `reason` says why it is not published; published."""


@dataclass(frozen=True, slots=True)
class RoadPart:
    """One part of a survey as it came."""

    survey_id: str
    part: int
    report_id: str
    layer: str
    vehicle: str
    received_ns: int
    body: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class OpenRoads:
    """Parts of a layer that nobody has mapped yet: how many, when the first and the last came, the newest arrival."""

    layer: str
    parts: int
    oldest_ns: int
    newest_ns: int
    arrival: int


@dataclass(frozen=True, slots=True)
class RoadTile:
    """What surveys have made of one tile: its quality and its age.

    Attributes:
        state, reason: how far it is, and why no farther.
        drives: that have voxels in it. vehicles: their names, each once.
        sigma_m: position sigma of the submaps that it is made of, the largest.
        apart_m: 90 % of the shared voxels lie nearer together between vehicles; None: too few are shared.
        voxels: that would be published. alone: that only one vehicle saw, or in which they disagree.
        first_ns, last_ns: when it was seen, UTC. updated_ns: when this was written.
        base_version: the newest version of the tile before any survey; 0: there was none.
        version: that surveys have published; 0: none.
        codec_id, body: the Gaussians, encoded: all of a draft, those published of a published tile.
    """

    layer: str
    tile: TileId
    state: RoadState
    reason: str
    drives: int
    vehicles: tuple[str, ...]
    sigma_m: float
    apart_m: float | None
    voxels: int
    alone: int
    first_ns: int
    last_ns: int
    updated_ns: int
    base_version: int
    version: int
    codec_id: int
    body: bytes = field(repr=False)
