"""A street as bytes: our tiles beside the street's points in LAZ and Draco."""

import io
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import (
    CODEC_FLOAT32_ZSTD,
    CODEC_STANDARD,
    CODEC_STANDARD_SETS,
    CODEC_STANDARD_SUMS,
    CODEC_STANDARD_ZSTD,
    CODECS,
    LATTICES,
    Codec,
    codec_of,
    snap,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from studies.codec_scenes import kl_median
from studies.speed.contest import Absent, Contest, Entrant
from studies.speed.scene import SpeedScene

CODEC: Final = "standard"
LAZ_STEP_M: Final = 0.01
DRACO_BITS: Final = 14
CLOUD_M: Final = 0.2
TILE_VOXELS: Final = 2_500
TILE_CODECS: Final = (CODEC_STANDARD, CODEC_STANDARD_SUMS, CODEC_STANDARD_ZSTD, CODEC_FLOAT32_ZSTD)
"""Beside the one by which tiles are written."""
NOT_HERE: Final = "not installed (extra `peers`)"


class MapCoder(NamedTuple):
    """Writes a street and reads it.

    Attributes:
        name: as it stands in the table.
        write: gives what `size` measures and `read` takes.
        read: gives what `judge` judges.
        size: bytes of what was written.
        judge: how far what was read is from what was written, in words.
    """

    name: str
    write: Callable[[], Any]
    read: Callable[[Any], Any]
    size: Callable[[Any], int]
    judge: Callable[[Any], str]


def coding_contests(scene: SpeedScene) -> list[Contest]:
    """Writing and reading."""
    held = {tile_id: scene.local_map.tile(tile_id) for tile_id in scene.local_map.tiles}
    tiles = {tile_id: tile.gaussians for tile_id, tile in held.items() if tile is not None and len(tile.gaussians)}
    cloud_m = _thinned(scene.cloud)
    notes = (
        f"The whole map of a street, {sum(map(len, tiles.values())):,} voxels of Gaussians, and the points they were"
        f" made of, one in each cube of {CLOUD_M} m ({len(cloud_m):,}). Not the same is coded: Gaussians by ours,"
        f" points by the others. LAZ (lazrs) in steps of {LAZ_STEP_M} m, Draco with its highest compression.",
    )
    ours, others = _ours(tiles), [*_laz(cloud_m), *_draco(cloud_m)]
    return [
        Contest("A street written", "ms", 1.0, _writing(ours), [_unless(one, _writing) for one in others], notes),
        Contest("A street read", "ms", 1.0, _reading(ours), [_unless(one, _reading) for one in others]),
    ]


def tile_contests(scene: SpeedScene) -> list[Contest]:
    """Writing and reading the largest tile of the street; times are brought to TILE_VOXELS voxels."""
    held = ((tile_id, scene.local_map.tile(tile_id)) for tile_id in scene.local_map.tiles)
    tile_id, tile = max(((i, t.gaussians) for i, t in held if t is not None), key=lambda one: len(one[1]))
    snapped, units = snap(tile, LATTICES[CODEC], new_map=True), len(tile) / TILE_VOXELS
    ours, *others = (_tile_coder(codec_of(i), tile_id, snapped) for i in (CODEC_STANDARD_SETS, *TILE_CODECS))
    notes = (
        f"The largest tile of the street, {len(tile):,} voxels; times are those of {TILE_VOXELS:,}. The Gaussians lie"
        " on the lattice *standard*, and their integers are known: a server has snapped the tile before.",
    )
    return [
        Contest("A tile written", "ms/tile", units, _writing(ours), [_writing(one) for one in others], notes),
        Contest("A tile read", "ms/tile", units, _reading(ours), [_reading(one) for one in others]),
    ]


def _tile_coder(codec: Codec, tile_id: TileId, gaussians: Gaussians) -> MapCoder:
    return MapCoder(
        codec.name,
        lambda: codec.encode(tile_id, gaussians),
        lambda body: codec.decode(tile_id, body),
        len,
        lambda found: "equal to the bit" if found == gaussians else "other Gaussians",
    )


def _unless(one: MapCoder | Absent, entrant: Callable[[MapCoder], Entrant]) -> Entrant | Absent:
    return one if isinstance(one, Absent) else entrant(one)


def _writing(coder: MapCoder) -> Entrant:
    return Entrant(coder.name, coder.write, lambda written: f"{coder.size(written) / 1e3:,.3g} kB")


def _reading(coder: MapCoder) -> Entrant:
    written = coder.write()
    return Entrant(coder.name, lambda: coder.read(written), coder.judge)


def _thinned(points: F64) -> F64:
    """The first point of each cube, in the order of the cubes."""
    _, first = np.unique(np.floor(points / CLOUD_M).astype(np.int64), axis=0, return_index=True)
    return points[first]


def _ours(tiles: dict[TileId, Gaussians]) -> MapCoder:
    lattice = LATTICES[CODEC]
    codec = next(one for one in CODECS.values() if one.lattice == lattice)
    return MapCoder(
        f"ours, {codec.name}",
        lambda: {tile_id: codec.encode(tile_id, snap(one, lattice)) for tile_id, one in tiles.items()},
        lambda bodies: {tile_id: codec.decode(tile_id, body) for tile_id, body in bodies.items()},
        lambda bodies: sum(map(len, bodies.values())),
        lambda found: f"median divergence of a Gaussian {kl_median(tiles, found):.1e} nats",
    )


def _laz(cloud_m: F64) -> Iterator[MapCoder | Absent]:
    try:
        import laspy
        import lazrs  # noqa: F401  (laspy says so only when it writes)
    except ImportError:
        yield Absent("LAZ", NOT_HERE)
        return
    backend = laspy.LazBackend.Lazrs

    def write() -> bytes:
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales, header.offsets = np.full(3, LAZ_STEP_M), np.zeros(3)
        file = laspy.LasData(header)
        file.x, file.y, file.z = cloud_m.T
        out = io.BytesIO()
        file.write(out, do_compress=True, laz_backend=backend)
        return out.getvalue()

    def read(body: bytes) -> F64:
        return np.asarray(laspy.read(io.BytesIO(body), laz_backend=backend).xyz)

    yield MapCoder("LAZ", write, read, len, lambda points: _off(points, cloud_m))


def _draco(cloud_m: F64) -> Iterator[MapCoder | Absent]:
    name = f"Draco, {DRACO_BITS} bits"
    try:
        import DracoPy
    except ImportError:
        yield Absent(name, NOT_HERE)
        return
    points = cloud_m.astype(np.float32)

    def write(*, preserve_order: bool = False) -> bytes:
        return bytes(
            DracoPy.encode(points, quantization_bits=DRACO_BITS, compression_level=10, preserve_order=preserve_order)
        )

    def read(body: bytes) -> Any:
        return np.asarray(DracoPy.decode(body).points)

    def judge(_: Any) -> str:
        return _off(read(write(preserve_order=True)), cloud_m)  # the order tells which point is which

    yield MapCoder(name, write, read, len, judge)


def _off(points: Any, original_m: F64) -> str:
    off_cm = 100 * np.sqrt(np.mean(np.sum((points - original_m) ** 2, axis=1)))
    return f"points off by {off_cm:.2f} cm (root mean square)"
