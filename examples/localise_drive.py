"""Localises a recorded drive on a map: python examples/localise_drive.py drive.mcap map.sqlite"""

import argparse
import sys

import numpy as np

import gnd

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("drive", help="MCAP of ours; `gnd import` makes one of other recordings")
parser.add_argument("map", help="the map's file")
args = parser.parse_args()

drive = gnd.open_drive(args.drive)
found = gnd.localise(drive, args.map, progress=lambda done, total: print(f"{done}/{total}", end="\r", file=sys.stderr))
poses = gnd.trajectory_of(found.refined)
way_m = np.linalg.norm(np.diff(poses.T_dst_vehicle[:, :3, 3], axis=0), axis=1).sum()
print(f"{drive.header.vehicle}: {len(poses)} poses of {found.counts.scans} scans, {way_m:.1f} m")
for t_ns, (east_m, north_m, up_m) in zip(poses.t_ns, poses.T_dst_vehicle[:, :3, 3], strict=True):
    print(f"{t_ns} {east_m:.3f} {north_m:.3f} {up_m:.3f}")
