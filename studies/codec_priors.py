"""Makes `gnd_map/codec/priors.bin`, the frozen start of the range codecs' contexts.

    gnd reproduce simulation --world-seed 101,102 --length 300 --vehicles 1,8 --no-pcd --out A
    gnd reproduce simulation --world-seed 101,102 --length 300 --vehicles 1 --base driven --no-pcd --out B
    python -m studies.codec_priors --out gnd_map/codec/priors.bin A B [--only tile-compact,delta-compact]

The tiles of the runs' base maps, the differences that each drive makes to them, and the drives' reports are encoded one
after the other while the contexts go on learning; where they end is where every stream will start. The file is part of
the codecs' meaning: another one makes other bytes, so it was made once, of the drives of A and the maps of both, and is
not made again.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from gnd.gnd_map.codec import (
    LATTICES,
    REPORT,
    Flags,
    encode_delta,
    encode_flags,
    encode_mask,
    encode_measured,
    encode_tiles,
    snap,
)
from gnd.gnd_map.codec.priors import STREAMS, learning, pack, priors_of
from gnd.gnd_map.codec.range_tile import encode_tile
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from studies.simulation.base_map import read_base
from studies.simulation.result import read_result

TRUST = {"tile": 40, "delta": 80, "flags": 60, "measured": 80, "tiles": 60, "mask": 30}
"""How many decisions what was learnt counts as: less where a stream is long and finds out for itself."""

Report = list[TileChange]


def main(arguments: Sequence[str]) -> None:
    """Learn from the runs in some folders and write the file."""
    chosen = _options(arguments)
    with learning() as states:
        for _ in range(2):
            for folder in chosen.folders:
                learn(folder)
    fresh = {name: state.frozen(trust_of(name)) for name, state in states.items()}
    kept = {name: priors_of(name) for name in STREAMS if chosen.only and name not in chosen.only}
    chosen.out.write_bytes(pack(fresh | kept))
    print(f"{chosen.out}: {chosen.out.stat().st_size} bytes")


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="runs of gnd reproduce simulation")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--only", type=lambda text: set(text.split(",")), default=set(), help="keep all other streams")
    return parser.parse_args(arguments)


def trust_of(stream: str) -> int:
    """See TRUST."""
    return TRUST[stream.partition("-")[0]]


def learn(folder: Path) -> None:
    """Encode everything in a folder of runs."""
    for world in sorted(path.parent for path in folder.glob("*/base-*.npz")):
        base = read_base(next(iter(world.glob("base-*.npz"))))
        reports = [
            report for path in sorted((world / "vehicles").glob("vehicle-*[0-9a-f].npz")) for report in _reports(path)
        ]
        for lattice in LATTICES.values():
            tiles = {tile_id: snap(g, lattice) for tile_id, g in base.tiles.items()}
            for tile_id, gaussians in tiles.items():
                encode_tile(tile_id, gaussians, lattice)
            for report in reports:
                for change in report:
                    _learn_delta(change, tiles.get(change.tile, Gaussians.empty()), lattice.name)
        standard = {tile_id: snap(g, LATTICES["standard"]) for tile_id, g in base.tiles.items()}
        for report in reports:
            _learn_report(report, standard)


def _reports(path: Path) -> Iterator[Report]:
    for body in read_result(path).reports:
        yield list(ChangeReport.decode(body).tiles)


def _learn_delta(change: TileChange, base: Gaussians, lattice: str) -> None:
    """All of a drive's changes, then neighbouring ones of a fiftieth of the tile: what returning vehicles are sent."""
    some = change.changed.voxel_id[: max(1, len(base) // 50)]
    for ids in (change.changed.voxel_id, some):
        said = snap(change.changed.select(ids), LATTICES[lattice])
        new = concat([base.take(~np.isin(base.voxel_id, ids)), said.take(said.exists)])
        encode_delta(change.tile, base, new)


def _learn_report(report: Report, tiles: dict[TileId, Gaussians]) -> None:
    bases = [tiles.get(change.tile, Gaussians.empty()) for change in report]
    encode_flags([_flags(change, base) for change, base in zip(report, bases, strict=True)])
    said = [snap(change.changed.take(change.changed.exists), REPORT) for change in report]
    encode_measured([(c.tile, base, m) for c, base, m in zip(report, bases, said, strict=True)])
    for _, group in groupby(report, lambda change: change.tile.district):
        encode_tiles([(change.tile.morton & 1023, change.base_version) for change in group])
    rng = np.random.default_rng(len(said))
    encode_mask(np.repeat(rng.random(64) < 0.7, 8))


def _flags(change: TileChange, base: Gaussians) -> Flags:
    """A change of a tile whose base the run had under another hash still says the same."""
    return Flags(change.tile, base, change.changed.voxel_id, change.change_class)


if __name__ == "__main__":
    main(sys.argv[1:])
