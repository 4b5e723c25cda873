"""What each codec weighs, what it does to Gaussians and to poses, and how long it takes.

On a simulated street and on real recordings: bytes a voxel of each codec and of what others would send; for each
lattice the median Kullback-Leibler divergence of the decoded Gaussians from the original ones, and how far apart the
poses are that scans find on the original and on the decoded map (`studies.codec_scenes`). Times are of one core,
brought to a tile of 2,500 voxels.
"""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import zstandard

from gnd.gnd_map.codec import CODECS, LATTICES, Codec, Lattice, encode_gaussians, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from studies.codec_scenes import (
    SEED,
    CodecScene,
    Tiles,
    kl_median,
    plain_protobuf,
    pose_shift_cm,
    recorded,
    simulated,
    stored,
)
from studies.frame.measure import Figure, core_s
from studies.frame.options import option

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data"
FOLDERS = ("kitti00_start16", "radiate_fog")
TILE_VOXELS = 2_500

Write = Callable[[TileId, Gaussians], bytes]


def _zstd(level: int) -> Write:
    return lambda _, g: zstandard.ZstdCompressor(level=level).compress(encode_gaussians(g))


PEERS: dict[str, Write] = {
    "protobuf of doubles, as the paper": lambda tile_id, g: plain_protobuf(tile_id, g, "double"),
    "protobuf of floats": lambda tile_id, g: plain_protobuf(tile_id, g, "float"),
    "float32 columns, zlib -9": lambda _, g: zlib.compress(encode_gaussians(g), 9),
    "float32 columns, zstd -19": _zstd(19),
}


@dataclass(frozen=True, slots=True)
class CodecOptions:
    """What is measured: a simulated street, or the tiles of a store; and real recordings."""

    seed: int = option(SEED, "World of the simulated street.")
    base: Path | None = option(None, "Its map, a file of a simulation's run.  [default: make it]")
    store: Path | None = option(None, "The tiles of this store instead; sizes and times only.")
    recordings: Path = option(RECORDINGS, f"Folder with {', '.join(FOLDERS)}.")


OPTIONS: Final = CodecOptions


def run(chosen: CodecOptions | None = None) -> list[Figure]:
    """Measure every scene that there is."""
    chosen = chosen or CodecOptions()
    first = simulated(chosen.seed, chosen.base) if chosen.store is None else stored(chosen.store)
    figures = [*_measured(first), *_times(first)]
    for name in FOLDERS:
        folder = chosen.recordings / name
        if folder.is_dir():
            figures += _measured(recorded(folder))
        else:
            figures.append(Figure(f"{name}: not measured", float("nan"), "", f"no folder {name} in --recordings"))
    return figures


def _measured(scene: CodecScene) -> Iterator[Figure]:
    """Sizes, then what each lattice does to Gaussians and poses."""
    snapped = {name: decoded_on(scene.tiles, lattice) for name, lattice in LATTICES.items()}
    for title, write in PEERS.items():
        yield _size(scene, title, write, scene.tiles)
    for codec in CODECS.values():
        tiles = scene.tiles if codec.lattice is None else snapped[codec.lattice.name]
        yield _size(scene, title_of(codec), codec.encode, tiles)
    for name, tiles in snapped.items():
        yield from _quality(scene, name, tiles)


def decoded_on(tiles: Tiles, lattice: Lattice) -> Tiles:
    """What comes out of the codecs of a lattice, which give back to the bit what lies on it."""
    return {tile_id: snap(gaussians, lattice) for tile_id, gaussians in tiles.items()}


def title_of(codec: Codec) -> str:
    """Its number and name."""
    return f"codec {codec.codec_id}, {codec.name}"


def _size(scene: CodecScene, title: str, write: Write, tiles: Tiles) -> Figure:
    total = sum(len(write(tile_id, gaussians)) for tile_id, gaussians in tiles.items())
    detail = f"{scene.voxels} voxels in {len(tiles)} tiles, {total} B"
    return Figure(f"{scene.name}: {title}", total / scene.voxels, "B/voxel", detail)


def _quality(scene: CodecScene, name: str, tiles: Tiles) -> Iterator[Figure]:
    yield Figure(f"{scene.name}: {name}, KL median", kl_median(scene.tiles, tiles), "nats", f"{scene.voxels} voxels")
    if scene.grid_frame is None:
        return
    shift = pose_shift_cm(scene.grid_frame, scene.tiles, tiles, scene.scans)
    detail = f"{len(shift)} of {len(scene.scans)} scans, 95 % below {np.quantile(shift, 0.95):.2f} cm"
    yield Figure(f"{scene.name}: {name}, pose shift median", float(np.median(shift)), "cm", detail)


def _times(scene: CodecScene) -> Iterator[Figure]:
    """Of the largest tile."""
    tile_id, gaussians = max(scene.tiles.items(), key=lambda item: len(item[1]))
    scale, detail = 1e3 * TILE_VOXELS / len(gaussians), f"{TILE_VOXELS} voxels, measured on {len(gaussians)}"
    for lattice in LATTICES.values():
        snapping_s = core_s(lambda lattice=lattice: snap(gaussians, lattice))  # type: ignore[misc]
        yield Figure(f"{lattice.name}: snap", snapping_s * scale, "ms/tile", detail)
    for codec in CODECS.values():
        content = gaussians if codec.lattice is None else snap(gaussians, codec.lattice)
        encode_s, decode_s = _seconds(codec, tile_id, content)
        yield Figure(f"{title_of(codec)}: encode", encode_s * scale, "ms/tile", detail)
        yield Figure(f"{title_of(codec)}: decode", decode_s * scale, "ms/tile", detail)


def _seconds(codec: Codec, tile_id: TileId, gaussians: Gaussians) -> tuple[float, float]:
    body = codec.encode(tile_id, gaussians)
    return core_s(lambda: codec.encode(tile_id, gaussians)), core_s(lambda: codec.decode(tile_id, body))
