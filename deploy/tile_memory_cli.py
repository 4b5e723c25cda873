"""`gnd map memory STORE TILE`: what a tile remembers of each voxel or feature."""

from datetime import UTC, datetime
from typing import Any

import click
from rich.console import Console

from gnd.gnd_map.day import UNKNOWN_DAY, ns_of
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import tables
from gnd.tile_store.arguments import parse_tile
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation
from gnd.tile_store.options import json_option, layer_option, show, to_read
from gnd.tile_store.values import StoredMemory


@click.command(short_help="The memory of a tile: last observation, observers and confidence of its voxels.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("tile")
@layer_option
@json_option
def memory(path: StoreLocation, tile: str, layer: str, as_json: bool) -> None:
    """What the closed windows of a TILE of STORE have left.

    Of each voxel: the vehicles that confirmed it, the day of its last observation, the votes that its state is worth
    now, and the claims against it that nobody has decided. Of each feature: whether it is published, the votes of the
    vehicles that spoke last, and how many have measured it.

    --json gives every voxel, or feature.
    """
    tile_id = parse_tile(tile)
    with to_read(path) as store:
        journal = store.in_play(layer, tile_id)
    if journal.memory is None:
        raise StoreError(f"tile {tile_id.path} of layer {layer}: no window is closed yet, so nothing is remembered")
    told = _features if is_feature_layer(layer) else _voxels
    values, rows = told(tile_id, journal.memory)
    values = {"tile": tile_id.path, "window": journal.memory.window, **values, "bytes": len(journal.memory.memory)}
    shown = values | {"each": rows} if as_json else values
    show(shown, as_json, lambda console: _print(console, values))


def _voxels(tile: TileId, stored: StoredMemory) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    # loaded here: it loads scipy and numba, which the other commands do without
    from gnd.cloud_merger.stored import decode_state

    state = decode_state(tile, stored)
    voxels, claims = state.memory.voxels, state.memory.claims
    weight = state.memory.support(voxels["voxel_id"], int(voxels["day"].max(initial=0)))
    held = set(state.gaussians.voxel_id.tolist())
    rows = [
        {"voxel_id": voxel, "is_there": voxel in held, "observers": observers, "last_day": _date(day), "votes": votes}
        for (voxel, observers, _, day), votes in zip(voxels.tolist(), weight.tolist(), strict=True)
    ]
    values: dict[str, Any] = {
        "voxels": len(rows),
        "with a Gaussian": len(held),
        "confirmed by one": int((voxels["observers"] == 1).sum()),
        "confirmed by seven or more": int((voxels["observers"] >= 7).sum()),
        "oldest observation": _date(int(voxels["day"].min(initial=UNKNOWN_DAY))),
        "claims not decided": len(claims),
        "vehicles that claim": len({one.vehicle for one in state.memory.witnesses}),
    }
    return values, rows


def _features(_tile: TileId, stored: StoredMemory) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    from gnd.cloud_merger.features.memory import LayerMemory  # loaded here: it loads scipy

    tracks = LayerMemory.decode(stored.memory).tracks
    rows = [
        {
            "feature_id": one.feature_id,
            "kind": one.kind,
            "is_published": one.is_published,
            "votes_for": sum(vote.existence.state == "exist" for _, vote in one.votes),
            "votes_against": sum(vote.existence.state == "absent" for _, vote in one.votes),
            "measured_by": len(one.measured) + one.vehicles_before,
            "last_day": _date(one.day),
        }
        for one in tracks
    ]
    values: dict[str, Any] = {
        "features": len(rows),
        "published": sum(one.is_published for one in tracks),
        "found by one vehicle": sum(bool(one.finder) for one in tracks),
        "of the neighbours": sum(one.is_away for one in tracks),
    }
    return values, rows


def _print(console: Console, values: dict[str, Any]) -> None:
    console.print(tables.fields(f"tile {values['tile']}", {name: v for name, v in values.items() if name != "tile"}))


def _date(day: int) -> str | None:
    return None if day == UNKNOWN_DAY else str(datetime.fromtimestamp(ns_of(day) / 1e9, UTC).date())
