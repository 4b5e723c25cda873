"""Feeds a vehicle and uploads what it reports: python examples/feed_vehicle.py drive.mcap map.sqlite

The measurements come from a recording here; a live system makes the same calls with those of its sensors.
"""

import argparse

import gnd
from gnd.schemas.drive import GnssFix, MotionSample, Scan

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("drive", help="MCAP of ours")
parser.add_argument("map", help="the map's file")
parser.add_argument("--connect", help="endpoint of a router: reports are uploaded there")
args = parser.parse_args()

drive, reports, n_poses = gnd.open_drive(args.drive), [], 0
with gnd.Vehicle.of_drive(args.map, drive.header) as vehicle:
    for item in drive:
        if isinstance(item, Scan):
            output = vehicle.push_scan(item.t_ns, item.points_m, item.t_offset_ns)
            n_poses += len(output.poses)
            print(f"{item.t_ns} {output.health} {output.cause}, {n_poses} poses are final")
        elif isinstance(item, MotionSample):
            output = vehicle.push_motion(item.t_ns, item.speed_mps, item.yaw_rate_radps)
        elif isinstance(item, GnssFix):
            output = vehicle.push(item)
        else:
            continue
        reports += output.reports
    reports += vehicle.finish().reports
print(f"{len(reports)} reports, {sum(len(report.body) for report in reports)} bytes")
if args.connect:
    with gnd.connect(args.connect) as client:
        for report in reports:
            print(f"{report.report_id} {client.upload(report)}")
