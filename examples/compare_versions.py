"""Says how a tile, or a whole map, has changed: python examples/compare_versions.py map.sqlite --tile 497353963154"""

import argparse
from datetime import UTC, datetime
from itertools import pairwise

import gnd

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("map", help="the map's file")
parser.add_argument("--tile", help="path, number, or lat,lon: each version of this tile against the one before")
parser.add_argument("--since", help="without --tile: the map now against the map then, such as 2026-01-31T12:00:00Z")
parser.add_argument("--layer", default="ndt")
args = parser.parse_args()

with gnd.Map(args.map) as opened:
    if args.tile is None:
        found = opened.diff(args.since, layer=args.layer)
        print(f"+{found.new} -{found.deleted} ~{found.modified} {found.noun} in {len(found.tiles)} tiles")
    else:
        versions = opened.history(args.tile, layer=args.layer)
        for old, new in pairwise(versions):
            found = opened.diff(old.version, new.version, tile=args.tile, layer=args.layer)
            when = datetime.fromtimestamp(new.created_ns * 1e-9, UTC)
            print(f"v{new.version} {when:%Y-%m-%d %H:%M} +{found.new} -{found.deleted} ~{found.modified} {found.noun}")
