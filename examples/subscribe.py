"""Prints every tile update of a layer and region: python examples/subscribe.py 13033/03021 --layer signs."""

import argparse
import time

import zenoh

from gnd.schemas.keys import catalog_keys, update_keys
from gnd.schemas.tiles import Catalog
from gnd.schemas.updates import TileUpdate

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("region", nargs="?", default="", help="one to four chunks of a tile path; nothing = everywhere")
parser.add_argument("--layer", default="ndt", help="ndt, or a feature layer such as signs")
parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of the router")
parser.add_argument("--every", type=float, default=10.0, help="seconds between comparisons with the catalog")
args = parser.parse_args()

config = zenoh.Config.from_json5('{"mode": "client", "scouting": {"multicast": {"enabled": false}}}')
config.insert_json5("connect/endpoints", f'["{args.connect}"]')
config.insert_json5("transport/shared_memory/enabled", "false")
versions: dict[str, int] = {}  # newest of each tile


def on_update(sample: zenoh.Sample) -> None:
    update = TileUpdate.decode(sample.payload.to_bytes())
    versions[update.tile.path] = max(update.version, versions.get(update.tile.path, 0))
    change = update.reason + (" +{} -{}".format(*update.voxels) if update.voxels else "")  # or of features
    print(f"{update.tile.path} v{update.previous_version} -> v{update.version} {change}", flush=True)


with zenoh.open(config) as session, session.declare_subscriber(update_keys(args.layer, args.region), on_update) as sub:
    print(f"listening to {sub.key_expr}", flush=True)
    while time.sleep(args.every) is None:  # a notice may be lost: the catalog has every tile
        replies = [reply.ok for reply in session.get(catalog_keys(args.layer, args.region)) if reply.ok]
        entries = [entry for ok in replies for entry in Catalog.decode(ok.payload.to_bytes()).entries]
        for tile, version in [(e.tile.path, e.version) for e in entries if e.tile.path.startswith(args.region)]:
            if version > versions.setdefault(tile, version):
                print(f"{tile} v{versions[tile]} -> v{version} by the catalog", flush=True)
                versions[tile] = version
