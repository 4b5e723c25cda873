"""Prints every tile update of a layer and region: python examples/subscribe.py 13033/03021 --layer signs."""

import argparse

import zenoh

from schemas.keys import update_keys
from schemas.updates import TileUpdate

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("region", nargs="?", default="", help="one to four chunks of a tile path; nothing = everywhere")
parser.add_argument("--layer", default="ndt", help="ndt, or a feature layer such as signs")
parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of the router")
args = parser.parse_args()

config = zenoh.Config.from_json5('{"mode": "client", "scouting": {"multicast": {"enabled": false}}}')
config.insert_json5("connect/endpoints", f'["{args.connect}"]')
config.insert_json5("transport/shared_memory/enabled", "false")
with zenoh.open(config) as session, session.declare_subscriber(update_keys(args.layer, args.region)) as updates:
    print(f"listening to {updates.key_expr}", flush=True)
    for sample in updates:
        update = TileUpdate.decode(sample.payload.to_bytes())
        change = update.reason + (" +{} -{}".format(*update.voxels) if update.voxels else "")  # or of features
        print(f"{update.tile.path} v{update.previous_version} -> v{update.version} {change}", flush=True)
