"""Reads the Gaussians of a map's file into numpy: python examples/read_map.py map.sqlite 13033/03021/**"""

import argparse

import numpy as np

import gnd

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("map", help="the map's file")
parser.add_argument("region", nargs="?", help="wildcard, tile, or lat,lon,radius in degrees and metres; nothing = all")
parser.add_argument("--at", help="the map as it was then, such as 2026-01-31T12:00:00Z")
parser.add_argument("--out", help="also write the columns to this .npz")
args = parser.parse_args()

with gnd.Map(args.map) as opened:
    found = opened.gaussians(args.region, at=args.at)
    print(f"layers {', '.join(opened.layers)}; {len(found)} Gaussians of {len(set(found.tile))} tiles")
if len(found):
    thickness_m = np.sqrt(np.maximum(np.linalg.eigvalsh(found.cov_m2)[:, 0], 0.0))
    print(f"latitudes {found.lat_deg.min():.6f} .. {found.lat_deg.max():.6f} degrees")
    print(f"longitudes {found.lon_deg.min():.6f} .. {found.lon_deg.max():.6f} degrees")
    print(f"heights {found.height_m.min():.1f} .. {found.height_m.max():.1f} m above the ellipsoid")
    print(f"median thickness {100 * np.median(thickness_m):.1f} cm, {found.count.sum(dtype=np.int64)} points")
if args.out:
    np.savez(args.out, mean_m=found.mean_m, cov_m2=found.cov_m2, count=found.count, day=found.day)
