"""Moving a street to another place of the Earth, with the reports that were made on it.

A street is moved east by whole districts (32 tiles each). Along a parallel the Earth looks the same everywhere: voxels
have the same numbers and sizes, tiles the same index within their district, and a track is written relative to its
district. So flags, track, mask and Gaussians of a report keep their bytes; what changes are the key, the tiles' ids,
and with these the content hashes, into which a tile's id enters.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from gnd.deploy.errors import LoadError
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import LON_TILES, District, TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.packed import PackedReport, digest_of

DISTRICT_TILES: Final = 32
"""Tiles along one side of a district."""
DISTRICTS_ROUND: Final = LON_TILES // DISTRICT_TILES
"""Districts along a parallel."""
GAP_DISTRICTS: Final = 1
"""Between two streets: no ray and no rule of neighbourhood reaches across it."""


def shifted_tile_id(tile: TileId, districts: int) -> TileId:
    """The tile so many districts east (negative: west), over the date line where need be."""
    return TileId.from_indices((tile.lon_index + DISTRICT_TILES * districts) % LON_TILES, tile.lat_index)


def shifted_district(district: District, districts: int) -> District:
    """The district so many districts east."""
    return shifted_tile_id(TileId(district.first_morton), districts).district


def shifted_tile(tile: Tile, districts: int) -> Tile:
    """The same voxels so many districts east; their hash is another."""
    return Tile(shifted_tile_id(tile.tile_id, districts), tile.version, tile.gaussians, tile.day)


@dataclass(frozen=True, slots=True)
class DistrictShift:
    """One copy of a street.

    Attributes:
        districts: how far east of the street itself.
        tiles: the street's tiles, as its vehicles held them.
    """

    districts: int
    tiles: Mapping[TileId, Tile]
    _shas: dict[bytes, bytes] = field(default_factory=dict, init=False, repr=False, compare=False)

    def sha(self, tile: TileId, base_sha: bytes) -> bytes:
        """The content hash here of what had `base_sha` there; b"" (no map) stays b"".

        Raises:
            LoadError: the street's tile has another content.
        """
        if base_sha and base_sha not in self._shas:
            held = self.tiles.get(tile)
            if held is None or held.sha != base_sha:
                raise LoadError(f"tile {tile}: a report was made against {base_sha.hex()[:16]}…, which is not its map")
            self._shas[base_sha] = content_sha(shifted_tile_id(tile, self.districts), held.gaussians)
        return self._shas[base_sha] if base_sha else b""

    def digest(self, bases: Iterable[tuple[TileId, bytes]]) -> bytes:
        """`PackedReport.base_digest` of a report about these (tile, hash) of the street."""
        return digest_of([self.sha(tile, sha) for tile, sha in bases])

    def packed(self, report: PackedReport, bases: Iterable[tuple[TileId, bytes]]) -> PackedReport:
        """The first half of a report in short, as its vehicle would have sent it here."""
        return replace(report, base_digest=self.digest(bases), is_patient=False)  # each is waited for by itself

    def whole(self, report: ChangeReport) -> ChangeReport:
        """A whole report, as its vehicle would have sent it here."""
        tiles = tuple(
            replace(
                change,
                tile=shifted_tile_id(change.tile, self.districts),
                base_sha=self.sha(change.tile, change.base_sha),
            )
            for change in report.tiles
        )
        return replace(report, district=shifted_district(report.district, self.districts), tiles=tiles)


def places_of_streets(tiles: Iterable[TileId], count: int) -> list[int]:
    """How far to shift each of `count` copies of a street so that they lie side by side, in districts.

    They are laid out towards the farther end of the parallel, none across the date line.

    Raises:
        LoadError: there is no room for so many.
    """
    columns = {tile.lon_index // DISTRICT_TILES for tile in tiles}
    west, east = min(columns), max(columns)
    step = east - west + 1 + GAP_DISTRICTS
    room_east = (DISTRICTS_ROUND - 1 - east) // step
    room_west = west // step
    if count - 1 > max(room_east, room_west):
        raise LoadError(f"{count} streets of {step - GAP_DISTRICTS} districts: the parallel has room for "
                        f"{max(room_east, room_west) + 1}; let more vehicles share one (--per-street)")  # fmt: skip
    sign = 1 if room_east >= room_west else -1
    return [sign * step * n for n in range(count)]
