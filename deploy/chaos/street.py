"""What the vehicles of a chaos run drive past and report: a street with its real short reports, kept in `street.bin`.

`python -m studies.chaos_street` makes the file of simulated drives: the map of the street, and of each report its
two halves. A vehicle of a run says what one of these reports says, or a part of it, in one of the districts that the
street is laid down in; which, is drawn from the seed, so the same seed gives the same reports, byte by byte.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.cloud_merger.expanding import expand, is_askable, with_measured
from gnd.deploy.errors import ChaosError
from gnd.gnd_map.codec import CODEC_STANDARD_ZSTD, codec_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.gnd_map.track import Track, decode_track
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import change_key
from gnd.schemas.packed import PackedGaussians, PackedReport, decode_upload
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.report.packing import pack

FILE: Final = Path(__file__).with_name("street.bin")
LAYER: Final = "ndt"
DISTRICTS: Final = 2
TILES_EAST: Final = 32  # of a district
SHARES: Final = (1.0, 0.7, 0.4, 0.0)
"""Share of the drive's changes that a report contains: vehicles observe different parts."""
T0_NS: Final = 1_700_000_000_000_000_000
EVERY_NS: Final = 20_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ToldReport:
    """One report of the file.

    Attributes:
        whole: with all Gaussians that were measured.
        track: where its vehicle was.
    """

    whole: ChangeReport
    track: Track


@dataclass(frozen=True, slots=True, eq=False)
class SentReport:
    """One report of one vehicle, as its outbox takes it."""

    whole: ChangeReport
    packed: PackedReport
    bases: tuple[Tile, ...]

    @property
    def key(self) -> str:
        """Where it is sent."""
        return change_key(self.whole.layer, self.whole.district)

    @property
    def bases_by_sha(self) -> dict[bytes, Gaussians]:
        """As the second half is coded against."""
        return {tile.sha: tile.gaussians for tile in self.bases}


@dataclass(frozen=True)
class ChaosStreet:
    """The map before the first drive, and what was found: `copies[k]` lies in the k-th district."""

    copies: tuple[tuple[Tile, ...], ...]
    told: tuple[ToldReport, ...]

    @property
    def tiles(self) -> list[Tile]:
        """All tiles of all districts, version 1."""
        return [tile for copy in self.copies for tile in copy]

    @cached_property
    def _held(self) -> tuple[dict[int, Tile], ...]:
        return tuple({_index(tile.tile_id): tile for tile in copy} for copy in self.copies)

    def said(self, seed: int, vehicle: str, number: int) -> SentReport:
        """The `number`-th report of a vehicle: the same whenever it is asked for."""
        rng = random.Random(f"{seed}/{vehicle}/{number}")
        district, told = rng.randrange(len(self.copies)), rng.choice(self.told)
        rows = np.random.default_rng(rng.getrandbits(63))
        share = rng.choice(SHARES)
        held = self._held[district]
        tiles = tuple(_thinned(_moved(one, held), share, rows) for one in told.whole.tiles)
        first_ns = T0_NS + number * EVERY_NS
        whole = replace(
            told.whole,
            report_id=deterministic_report_id(first_ns // 1_000_000, "chaos", str(seed), vehicle, str(number)),
            vehicle=vehicle,
            district=tiles[0].tile.district,
            first_ns=first_ns,
            last_ns=first_ns + told.whole.last_ns - told.whole.first_ns,
            tiles=tiles,
        )
        bases = tuple(held[_index(one.tile)] for one in tiles if one.base_version)
        track = replace(told.track, district=whole.district)
        return SentReport(whole, pack(whole, {tile.sha: tile.gaussians for tile in bases}, track), bases)


def _index(tile: TileId) -> int:
    return tile.morton - tile.district.first_morton


def _moved(change: TileChange, held: dict[int, Tile]) -> TileChange:
    """The same about the tile at the same place of another district."""
    index = _index(change.tile)
    first = next(iter(held.values())).tile_id.district.first_morton
    sha = held[index].sha if change.base_version else b""
    return replace(change, tile=TileId(first + index), base_sha=sha)


def _thinned(change: TileChange, share: float, rows: np.random.Generator) -> TileChange:
    """A part of the changes; the others are left out, and only the track tells about their voxels."""
    chosen = np.flatnonzero(rows.random(len(change.changed)) < share)
    return replace(
        change,
        changed=change.changed.take(chosen),
        change_class=change.change_class[chosen],
        evidence=change.evidence[chosen],
    )


def write_street(
    path: Path, layer: str, district: District, tiles: Sequence[Tile], halves: Sequence[tuple[bytes, bytes]]
) -> None:
    """Write a street: its map, and of each report its flags and all of its Gaussians."""
    encode = codec_of(CODEC_STANDARD_ZSTD).encode
    arrays = {f"tile-{tile.tile_id.morton}": encode(tile.tile_id, tile.gaussians) for tile in tiles}
    for number, (flags, gaussians) in enumerate(halves):
        arrays |= {f"flags-{number}": flags, f"gaussians-{number}": gaussians}
    held: dict[str, Any] = {name: np.frombuffer(body, np.uint8) for name, body in arrays.items()}
    with path.open("wb") as file:
        np.savez(file, key=np.array(change_key(layer, district)), **held)


def read_street(path: Path = FILE, districts: int = DISTRICTS) -> ChaosStreet:
    """Read a street and lay it down in so many districts, one east of the other.

    Raises:
        ChaosError: the file holds no street.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name].tobytes() for name in file.files if name != "key"}
    except (OSError, ValueError) as error:
        raise ChaosError(f"{path}: no street can be read: {error}") from error
    decode = codec_of(CODEC_STANDARD_ZSTD).decode
    ids = {name: TileId(int(name.removeprefix("tile-"))) for name in arrays if name.startswith("tile-")}
    base = [Tile(tile_id, 1, decode(tile_id, arrays[name])) for name, tile_id in ids.items()]
    count = sum(name.startswith("flags-") for name in arrays)
    if not base or not count:
        raise ChaosError(f"{path}: {len(base)} tiles and {count} reports, a street has both")
    told = [_told(base, arrays[f"flags-{n}"], arrays[f"gaussians-{n}"]) for n in range(count)]
    copies = tuple(tuple(_laid(tile, k) for tile in base) for k in range(districts))
    return ChaosStreet(copies, tuple(told))


def _laid(tile: Tile, districts_east: int) -> Tile:
    at = TileId.from_indices(tile.tile_id.lon_index + TILES_EAST * districts_east, tile.tile_id.lat_index)
    return Tile(at, 1, tile.gaussians)


def _told(base: Sequence[Tile], flags: bytes, gaussians: bytes) -> ToldReport:
    """The whole report out of its two halves, as the cloud puts it together."""
    first, second = decode_upload(flags), decode_upload(gaussians)
    if not isinstance(first, PackedReport) or not isinstance(second, PackedGaussians):
        raise ChaosError(f"a report of {type(first).__name__} and {type(second).__name__} has no two halves")
    district = base[0].tile_id.district
    held = {_index(tile.tile_id): tile for tile in base}
    bases = [
        held[index] if version else Tile(TileId(district.first_morton + index), 0, Gaussians.empty())
        for index, version in first.tiles
    ]
    bare = expand(first, LAYER, district, bases)
    every = np.ones(sum(int(is_askable(one).sum()) for one in bare.tiles), np.bool_)
    by_id = {tile.tile_id: tile.gaussians for tile in bases}
    return ToldReport(with_measured(bare, by_id, every, second.measured), decode_track(district, first.track))
