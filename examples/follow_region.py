"""Follows a region and says what each new version changed: python examples/follow_region.py 13033/03021/**"""

import argparse
import contextlib

import gnd

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("region", nargs="?", help="wildcard, tile, or lat,lon,radius in degrees and metres; nothing = all")
parser.add_argument("--layer", action="append", help="ndt, or a feature layer such as signs; repeatable")
parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of the router")
args = parser.parse_args()


def size_of(tile: gnd.Tile | gnd.FeatureTile) -> str:
    return f"{len(tile.gaussians)} Gaussians" if isinstance(tile, gnd.Tile) else f"{len(tile.features)} features"


with contextlib.suppress(KeyboardInterrupt), gnd.connect(args.connect) as client:
    for update in client.subscribe(args.region, layers=args.layer or ["ndt"], existing=True):
        before = f", before {size_of(update.before)}" if update.before else ""
        what = f"{size_of(update.tile)}{before}"
        print(f"{update.layer} {update.tile.tile_id} v{update.version} {update.reason}: {what}", flush=True)
