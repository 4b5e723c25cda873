"""`gnd map status`: what a map is waiting for."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from math import degrees
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import SchemaError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import json_option, show, to_read
from gnd.tile_store.store import Store
from gnd.tile_store.values import VehicleAccount, WaitingChange, WaitingReason

WORDS: Final[dict[WaitingReason, str]] = {
    "share": "more of the tile than one vehicle is believed",
    "isolated": "single voxels, nothing beside them",
    "poses": "its poses were known poorly",
    "doubtful": "the vehicle doubts it itself",
    "shift": "a shift of its poses explains it",
    "named": "its reports are shifted again and again",
    "parked": "the shape of a vehicle, and has not stood for long",
    "season": "leaves of a tree that stayed",
    "contradicted": "others contradict most of what it claims, there or elsewhere",
    "day": "it has changed as much alone on that day as one vehicle may",
    "quarantined": "its reports do not count (`gnd vehicles why`)",
}

DOUBTED: Final = ("doubtful", "shift")
"""Reasons behind which the vehicle may have some of its own."""


@click.command(short_help="What the map waits for: confirmation, merging, people.")
@click.argument("path", metavar="STORE", type=LOCATION)
@json_option
def status(path: StoreLocation, as_json: bool) -> None:
    """How STORE stands: its shards and its queue, tiles set aside, unconfirmed changes, vehicles to be checked, refused
    messages.
    """
    with to_read(path) as store:
        values = status_of(store)
    show(values, as_json, lambda console: print_status(console, shown(path), values))


def status_of(store: Store) -> dict[str, Any]:
    """How the store stands, in plain values; each key is one table or line of `gnd map status`."""
    waiting = store.waiting_changes()
    claims = [asdict(one) | {"tile": one.tile.path, "doubts": _doubts_of(store, one)} for one in waiting]
    state, counts = store.queue_state(), store.counts()
    return {
        "shards": [asdict(one) | {"is_alive": one.is_alive} for one in store.shards()],
        "queue": {
            "tiles": counts.dirty,
            "report_parts": counts.waiting,
            "overdue_s": state.overdue_s,
            "waiting_s": state.waiting_s,
        },
        "merge_lag_s": {"p50": state.lag_s(0.5), "p95": state.lag_s(0.95), "max": state.lag_s(1.0)},
        "set_aside": [asdict(one) | {"tile": one.tile.path} for one in store.tiles_set_aside()],
        "waiting_for_confirmation": _totals(waiting) | {"claims": claims},
        "named_vehicles": named_vehicles(store),
        "to_merge": [asdict(one) | {"tile": one.tile.path} for one in store.dirty_tiles()],
        "uploads": dict(store.upload_counts().by_state),
        "windows": _windows(store),
        "quarantined": state.quarantined,
        "quarantined_bytes": state.quarantined_bytes,
    }


def _windows(store: Store) -> dict[str, int]:
    """Tiles with a journal, their open windows' reports, windows folded so far, and the most that wait to be folded."""
    windows = [one for one in store.windows() if one.window > 0]
    behind = [one.window - 1 - (one.folded or 0) for one in windows]
    return {
        "tiles": len(windows),
        "reports_in_open": sum(one.reports for one in windows),
        "folded": sum(one.folded or 0 for one in windows),
        "most_behind": max(behind, default=0),
    }


def _doubts_of(store: Store, waiting: WaitingChange) -> list[str]:
    """In words why the vehicle itself doubts what waits, of all its reports about the tile that count."""
    if waiting.reason not in DOUBTED:
        return []
    words: dict[str, None] = {}
    for row in store.in_play(waiting.layer, waiting.tile).reports:
        if row.vehicle == waiting.vehicle:
            with suppress(SchemaError):  # a damaged body is the merger's to tell
                doubts = (change.doubt for change in ChangeReport.decode(row.body).tiles)
                words |= dict.fromkeys(word for doubt in doubts if doubt is not None for word in doubt.words)
    return list(words)


def waiting_totals(store: Store) -> dict[str, int]:
    """How many tiles and voxels wait for a second witness, how many voxels for having stood long enough, and how many
    follow the season; a voxel counts once for each vehicle that claims it.
    """
    return _totals(store.waiting_changes())


def _totals(waiting: Sequence[WaitingChange]) -> dict[str, int]:
    held = Counter[WaitingReason]()
    for one in waiting:
        held[one.reason] += one.voxels
    parked, season = held.pop("parked", 0), held.pop("season", 0)
    tiles = {(one.layer, one.tile) for one in waiting if one.reason in held}
    return {"tiles": len(tiles), "voxels": held.total(), "parked": parked, "season": season}


def named_vehicles(store: Store) -> list[dict[str, Any]]:
    """The vehicles that somebody should look at: their accounts, and one line that tells why."""
    return [asdict(one) | {"says": naming_line(one)} for one in store.vehicle_accounts() if one.is_named]


def naming_line(account: VehicleAccount) -> str:
    """Such as "vehicle v3: 17 of 20 tiles explained by a shift of 0.31 m (0.30 m left), 0.5°: check its mount"; empty
    where there is nothing against its mount.
    """
    if not account.is_named:
        return ""
    says = []
    if account.is_shifted:
        shift = (
            f"{account.length_m:.2f} ± {account.length_sd_m:.2f} m{_along(account)}, {degrees(account.turn_rad):.1f}°"
        )
        by = f"explained by a shift of {shift}" if account.length_m > 0.0 else "contradicted by the other vehicles"
        says.append(f"{account.explained} of {account.tested} tiles {by}")
    if account.is_turned:
        turn = f"{abs(degrees(account.course_rad)):.2f} ± {degrees(account.course_sigma_rad):.2f}°"
        side = "left" if account.course_rad > 0 else "right"
        says.append(
            f"drives {turn} to the {side} of its own heading, by its reports about {account.course_tiles} tiles"
        )
    return f"vehicle {account.vehicle}: {'; '.join(says)}: check its mount"


def _along(account: VehicleAccount) -> str:
    if account.forward_m is None or account.left_m is None:
        return ""
    sides = (_side(account.forward_m, "forward", "back"), _side(account.left_m, "left", "right"))
    return f" ({', '.join(sides)})"


def _side(length_m: float, ahead: str, behind: str) -> str:
    return f"{abs(length_m):.2f} m {ahead if length_m >= 0 else behind}"


def print_status(console: Console, title: str, values: dict[str, Any]) -> None:
    """One line for shards and queue, then one table for each thing that waits, and one line where nothing does."""
    waiting, to_merge, named = values["waiting_for_confirmation"], values["to_merge"], values["named_vehicles"]
    lines = [_shards_line(values["shards"]), *_queue_lines(values)]
    for line in [*lines, *(one["says"] for one in named)]:
        console.print(line, highlight=False, soft_wrap=True)
    if values["set_aside"]:
        console.print(_aside_table(values["set_aside"]))
    if waiting["claims"]:
        console.print(_waiting_table(waiting))
    if to_merge:
        console.print(_merge_table(to_merge))
    if values["quarantined"]:
        size = f"{values['quarantined']} messages in quarantine ({values['quarantined_bytes'] / 1e6:.2f} MB)"
        console.print(f"{size}: see `gnd map quarantine`", highlight=False, soft_wrap=True)
    if not (named or waiting["claims"] or to_merge or values["quarantined"] or values["set_aside"]):
        console.print(
            f"{title}: all reports merged, nothing waits for confirmation, none refused",
            highlight=False,
            soft_wrap=True,
        )


def _shards_line(shards: list[dict[str, Any]]) -> str:
    alive = [one["owner"] for one in shards if one["is_alive"]]
    gone = [one["owner"] for one in shards if not one["is_alive"]]
    line = f"merger shards: {', '.join(alive) or 'none is running'}"
    return f"{line}; ended without saying so: {', '.join(gone)}" if gone else line


def _queue_lines(values: dict[str, Any]) -> list[str]:
    queue, lag = values["queue"], values["merge_lag_s"]
    lines = []
    if queue["tiles"]:
        lines.append(
            f"queue: {queue['tiles']} tiles, {queue['report_parts']} report parts, the oldest waits for"
            f" {queue['waiting_s']:.1f} s; the first tile is overdue by {queue['overdue_s']:.1f} s"
        )
    if lag["p50"] is not None:
        lines.append(
            f"from receipt to published version: median {lag['p50']:.2f} s, 95 % {lag['p95']:.2f} s,"
            f" longest {lag['max']:.2f} s"
        )
    windows, uploads = values["windows"], values["uploads"]
    if windows["tiles"]:
        lines.append(
            f"windows: {windows['reports_in_open']} reports in the open windows of {windows['tiles']} tiles,"
            f" {windows['folded']} windows folded, at most {max(windows['most_behind'], 0)} behind"
        )
    open_uploads = [f"{n} {state}" for state, n in uploads.items() if n and state in ("waiting", "early", "wanted")]
    if open_uploads:
        lines.append(f"uploads acknowledged and not settled: {', '.join(open_uploads)}")
    return lines


def _aside_table(aside: list[dict[str, Any]]) -> Table:
    title = f"{len(aside)} tiles set aside; their reports wait (`gnd map check`, then `gnd map retry`)"
    table = Table("layer", "tile", "reports", "attempts", "since (UTC)", "because", title=title)
    for one in aside:
        numbers = (str(one["reports"]), str(one["attempts"]), _time(one["since_ns"]))
        table.add_row(one["layer"], one["tile"], *numbers, one["reason"])
    return table


def _waiting_table(waiting: dict[str, Any]) -> Table:
    title = (
        f"waiting for confirmation by a second vehicle or drive: {waiting['voxels']} voxels in {waiting['tiles']} tiles"
        + (f"; parked: {waiting['parked']} voxels" if waiting["parked"] else "")
        + (f"; leaves: {waiting['season']} voxels" if waiting["season"] else "")
    )
    table = Table("layer", "tile", "vehicle", "voxels", "of seen", "since (UTC)", "because", title=title)
    for one in waiting["claims"]:
        numbers = (str(one["voxels"]), str(one["seen"]), _time(one["since_ns"]))
        why = WORDS.get(one["reason"], one["reason"])
        doubts = f": {', '.join(word.replace('_', ' ') for word in one['doubts'])}" if one["doubts"] else ""
        table.add_row(one["layer"], one["tile"], one["vehicle"], *numbers, why + doubts)
    return table


def _merge_table(to_merge: list[dict[str, Any]]) -> Table:
    table = Table("layer", "tile", "reports", "attempts", "", title=f"{len(to_merge)} tiles to merge")
    for one in to_merge:
        numbers = (str(one["reports"]), str(one["attempts"]))
        table.add_row(one["layer"], one["tile"], *numbers, "at work" if one["is_leased"] else "")
    return table


def _time(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
