"""`gnd map memory STORE TILE`: what a tile remembers of each voxel."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from gnd_map.day import UNKNOWN_DAY, ns_of
from tile_store import tables
from tile_store.arguments import parse_tile
from tile_store.errors import StoreError
from tile_store.options import PATH, json_option, layer_option, show, to_read


@click.command(short_help="What a tile remembers: when voxels were last observed, by how many, how sure they are.")
@click.argument("path", metavar="STORE", type=PATH)
@click.argument("tile")
@layer_option
@json_option
def memory(path: Path, tile: str, layer: str, as_json: bool) -> None:
    """What the closed windows of a TILE of STORE have left.

    Of each voxel: the vehicles that confirmed it, the day of its last observation, the votes that its state is worth
    now, and the claims against it that nobody has decided.

    --json gives every voxel.
    """
    # loaded here: it loads scipy and numba, which the other commands do without
    from cloud_merger.stored import decode_state

    tile_id = parse_tile(tile)
    with to_read(path) as store:
        journal = store.in_play(layer, tile_id)
    if journal.memory is None:
        raise StoreError(f"tile {tile_id.path} of layer {layer}: no window is closed yet, so nothing is remembered")
    state = decode_state(tile_id, journal.memory)
    voxels, claims = state.memory.voxels, state.memory.claims
    weight = state.memory.support(voxels["voxel_id"], int(voxels["day"].max(initial=0)))
    held = set(state.gaussians.voxel_id.tolist())
    rows = [
        {"voxel_id": voxel, "is_there": voxel in held, "observers": observers, "last_day": _date(day), "votes": votes}
        for (voxel, observers, _, day), votes in zip(voxels.tolist(), weight.tolist(), strict=True)
    ]
    values: dict[str, Any] = {
        "tile": tile_id.path,
        "window": journal.memory.window,
        "voxels": len(rows),
        "with a Gaussian": len(held),
        "confirmed by one": int((voxels["observers"] == 1).sum()),
        "confirmed by seven or more": int((voxels["observers"] >= 7).sum()),
        "oldest observation": _date(int(voxels["day"].min(initial=UNKNOWN_DAY))),
        "claims not decided": len(claims),
        "vehicles that claim": len({one.vehicle for one in state.memory.witnesses}),
        "bytes": len(journal.memory.memory),
    }
    shown = values | {"each": rows} if as_json else values
    show(shown, as_json, lambda console: _print(console, values))


def _print(console: Console, values: dict[str, Any]) -> None:
    console.print(tables.fields(f"tile {values['tile']}", {name: v for name, v in values.items() if name != "tile"}))


def _date(day: int) -> str | None:
    return None if day == UNKNOWN_DAY else str(datetime.fromtimestamp(ns_of(day) / 1e9, UTC).date())
