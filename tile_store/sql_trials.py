"""Trials in SQL: each function runs inside the caller's transaction."""

import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import Row, SqlConnection, change, fetch, post
from gnd.tile_store.regions import morton_range
from gnd.tile_store.trials import (
    ARM_MOST,
    SETTLED_KEPT,
    DoubtedReport,
    Steering,
    TrialState,
    TrialTerms,
    VehicleHealth,
    VersionTrial,
)


def begin(c: SqlConnection, layer: str, tile: TileId, versions: tuple[int, int], terms: TrialTerms, now: int) -> None:
    """Put a version on trial, and take back its notice: who is among the first finds it with the next question.

    `versions`: the released one and the new one.
    """
    base_version, version = versions
    place = {"layer": layer, "tile": tile.morton, "version": version}
    told = {"base_version": base_version, "share": terms.share, "longest_ns": round(terms.longest_s * 1e9)}
    post(c, "insert_trial", place | told | {"since_ns": now})
    post(c, "delete_notice", place)


def open_trials(c: SqlConnection, layer: str, prefix: str = "") -> dict[TileId, VersionTrial]:
    """The open trials of a region by tile."""
    return trials_between(c, layer, *morton_range(prefix))


def trials_between(c: SqlConnection, layer: str, first: int, end: int) -> dict[TileId, VersionTrial]:
    """The open trials of the tiles from a Morton code to before another one, by tile."""
    rows = fetch(c, "open_trials", {"layer": layer, "first": first, "end": end})
    if not rows:
        return {}
    salt: bytes = fetch(c, "trial_salt")[0][0]
    return {(one := _trial(row, salt)).tile: one for row in rows}


def open_trial(c: SqlConnection, layer: str, tile: TileId) -> VersionTrial | None:
    """The open trial of a tile."""
    return open_trials(c, layer, tile.path).get(tile)


def all_open(c: SqlConnection) -> list[VersionTrial]:
    """Every open trial, by layer and tile."""
    layers = [layer for (layer,) in fetch(c, "layers_on_trial")]
    return [trial for layer in layers for trial in open_trials(c, layer).values()]


def settled(c: SqlConnection, n: int) -> list[VersionTrial]:
    """The settled trials, newest first."""
    return [_trial(row) for row in fetch(c, "settled_trials", {"n": n})]


def of_tile(c: SqlConnection, layer: str, tile: TileId) -> list[VersionTrial]:
    """All trials of a tile that are known, oldest first."""
    return [_trial(row) for row in fetch(c, "trials_of_tile", {"layer": layer, "tile": tile.morton})]


def set_state(c: SqlConnection, trial: VersionTrial, state: TrialState, verdict: str, now: int) -> bool:
    """Change an open trial; False, and nothing is changed: it is settled already. What vehicles told goes with it."""
    place = {"layer": trial.layer, "tile": trial.tile.morton, "version": trial.version}
    settled_ns = None if state in ("trial", "paused") else now
    if change(c, "set_trial", place | {"state": state, "settled_ns": settled_ns, "verdict": verdict}) != 1:
        return False
    if settled_ns is not None:
        post(c, "forget_trial_health", place)
        post(c, "forget_trials", {"keep": SETTLED_KEPT})
    return True


def supersede(c: SqlConnection, layer: str, tile: TileId, now: int) -> None:
    """A base or a rollback that somebody asked for takes the place of a version on trial."""
    trial = open_trial(c, layer, tile)
    if trial is not None:
        set_state(c, trial, "superseded", trial.verdict, now)


def put_health(c: SqlConnection, trial: VersionTrial, told: VehicleHealth, now: int) -> bool:
    """Keep what a vehicle tells; False: it is older than what is known, or enough vehicles have spoken."""
    row: dict[str, Any] = {name: getattr(told, name) for name in VehicleHealth.__slots__ if name != "first_ns"}
    place = {"layer": trial.layer, "tile": trial.tile.morton, "version": trial.version}
    return change(c, "put_trial_health", row | place | {"now": now, "most": ARM_MOST}) == 1


def told_ns(c: SqlConnection, trial: VersionTrial, vehicle: str) -> int:
    """The time of what a vehicle told last of an open trial, by its clock; -1: nothing."""
    place = {"layer": trial.layer, "tile": trial.tile.morton, "version": trial.version, "vehicle": vehicle}
    rows = fetch(c, "trial_told", place)
    return int(rows[0][0]) if rows else -1


def health(c: SqlConnection, trial: VersionTrial) -> list[VehicleHealth]:
    """What vehicles have told of an open trial, by vehicle."""
    place = {"layer": trial.layer, "tile": trial.tile.morton, "version": trial.version}
    return [VehicleHealth(*row) for row in fetch(c, "trial_health", place)]


VersionPlace = tuple[str, TileId, int]
"""Layer, tile and version."""


def doubt(c: SqlConnection, of: VersionPlace, report_ids: Iterable[str], now: int) -> None:
    """The reports behind a version that was taken back are doubted from now on."""
    place = {"layer": of[0], "tile": of[1].morton, "version": of[2]}
    post(c, "put_doubted_report", place | {"ids": json.dumps(list(report_ids)), "now": now})


def doubted_vehicles(c: SqlConnection, layer: str, tile: TileId) -> frozenset[str]:
    """The vehicles whose reports about a tile are doubted."""
    return frozenset(name for (name,) in fetch(c, "doubted_vehicles", {"layer": layer, "tile": tile.morton}))


def doubted_reports(c: SqlConnection, layer: str, tile: TileId) -> list[DoubtedReport]:
    """The reports about a tile that are or were doubted, by version and id."""
    return [DoubtedReport(*row) for row in fetch(c, "doubted_reports", {"layer": layer, "tile": tile.morton})]


def clear_doubts(c: SqlConnection, layer: str, tile: TileId, who: str, now: int) -> int:
    """The doubted reports about a tile are believed again; how many were doubted."""
    return change(c, "clear_doubted", {"layer": layer, "tile": tile.morton, "who": who, "now": now})


def steer(c: SqlConnection, of: VersionPlace, who: str, action: str, why: str, now: int) -> None:
    """Write down who does what to a version."""
    place = {"layer": of[0], "tile": of[1].morton, "version": of[2]}
    post(c, "steer", place | {"who": who, "action": action, "why": why, "now": now})


def steered(c: SqlConnection, layer: str, tile: TileId) -> list[Steering]:
    """Who did what to the versions of a tile, oldest first."""
    return [Steering(*row) for row in fetch(c, "steered", {"layer": layer, "tile": tile.morton})]


def _trial(row: Row, salt: bytes = b"") -> VersionTrial:
    layer, tile, *rest = row
    return replace(VersionTrial(layer, TileId(tile), *rest), salt=salt)
