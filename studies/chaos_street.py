"""Write the street of `gnd chaos`: the map and the short reports of the simulated drives of `short_corpus`."""

import argparse
from pathlib import Path

import numpy as np

from gnd.deploy.chaos.street import FILE, write_street
from gnd.gnd_map.codec import encode_mask
from gnd.vehicle_agent.report.packing import askable, pack_measured
from studies.short_corpus import Corpus, corpus


def main() -> None:
    """Drive (or take the drives that are kept), and write."""
    parser = argparse.ArgumentParser(prog="python -m studies.chaos_street", description=__doc__)
    parser.add_argument("--out", type=Path, default=FILE, help="file to write (default: that of `gnd chaos`)")
    write(corpus(), parser.parse_args().out)


def write(found: Corpus, path: Path) -> None:
    """Flags as they were sent, and all Gaussians as if all were wanted."""
    halves = [
        (one.packed.encode(), pack_measured(one.whole, found.bases(), _every(askable(one.whole))).encode())
        for one in found.reports
    ]
    tiles = [tile for tile in found.tiles() if len(tile.gaussians)]
    write_street(path, "ndt", found.reports[0].whole.district, tiles, halves)


def _every(count: int) -> bytes:
    return encode_mask(np.ones(count, np.bool_))


if __name__ == "__main__":
    main()
