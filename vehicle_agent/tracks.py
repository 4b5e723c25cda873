"""Where the vehicle was while its scans counted, report by report: it stands for the list of voxels observed."""

from collections.abc import Collection, Iterable

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import District, TileId
from gnd.gnd_map.track import Track
from gnd.gnd_map.track_builder import TrackBuilder


class Tracks:
    """Remembers the scans that count for as long as a tile that they may have seen is not reported.

    Args:
        frame: the map frame.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self._builder = TrackBuilder(frame)
        self._since_ns: dict[TileId, int] = {}  # of tiles not reported yet: no scan before this saw them
        self._looked_ns = 0
        self._last_ns = 0

    def __len__(self) -> int:
        return len(self._builder)

    def add_scan(self, t_ns: int, ends_map_m: F64, starts_map_m: F64, T_map_vehicle: F64) -> None:
        """Take a scan whose rays (N, 3) were counted, map frame, from a pose (4, 4)."""
        self._last_ns = max(self._last_ns, t_ns)
        self._builder.add_scan(t_ns, ends_map_m, starts_map_m, T_map_vehicle)

    def touched(self, tiles: Iterable[TileId]) -> None:
        """All tiles about which there is evidence now; those not known here were touched since the last call."""
        for tile in tiles:
            self._since_ns.setdefault(tile, self._looked_ns)
        self._looked_ns = self._last_ns

    def take(self, district: District, tiles: Collection[TileId]) -> Track:
        """The track of the scans that saw these tiles of the district; they are reported now.

        Raises:
            TrackError: no scan was near them, or more than a track can hold.
        """
        since_ns = min(self._since_ns.pop(tile, 0) for tile in tiles)
        try:
            return self._builder.track(district, tiles, since_ns)
        finally:
            self._builder.forget_before(min(self._since_ns.values(), default=self._looked_ns))
