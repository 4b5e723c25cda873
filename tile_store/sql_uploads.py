"""Uploads in SQL: each function runs inside the caller's transaction."""

import secrets
from collections.abc import Callable, Iterable, Sequence
from hashlib import sha256
from typing import Any, Final

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import borders
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store.connection import Lock, QueueClock, Row, SqlConnection, change, fetch, post
from gnd.tile_store.errors import IdTaken
from gnd.tile_store.places import put_place
from gnd.tile_store.retention import QUARANTINE, trim_quarantine
from gnd.tile_store.uploads import FirstHalf, Settled, Upload, UploadClaim, UploadCounts, UploadStatus
from gnd.tile_store.values import PutStatus, ReportRow, StoreConfig

NS_PER_S: Final = 1_000_000_000
HEAD_START_NS: Final = NS_PER_S
"""So long an upload is left to the shard that received it, which holds its tiles in memory."""
HELP_FACTOR: Final = 2.0
"""Where a shard has some of its own to look at, it helps with what has waited so many times as long."""
NEVER_NS: Final = (1 << 63) - 1
MOST_OWN: Final = 1024
"""Of a shard's own uploads the oldest are looked at to find whose they are; where there are more ..."""
MOST_OWN_VEHICLES: Final = 256
"""... so many vehicles are tried whose turn it is."""
MOST_TURNS: Final = 4096
"""Vehicles that are looked at to find whose turn it is."""
AT_ONCE_OF_VEHICLE: Final = 2
"""Uploads of one vehicle that are claimed together, at least."""
InTurnOf = Callable[[list[str]], list[str]]
"""Brings vehicles into the order of their turns."""
LONGEST_LEASE_NS: Final = 3600 * NS_PER_S
"""A lease that ends later than this from now was not written by this clock: it counts as ended."""


def locks_of(upload: Upload) -> list[Lock]:
    """Of what is known about a report: its halves, and those of another form."""
    return [("report", upload.report_id)]


def locks_to_settle(settled: Settled) -> list[Lock]:
    """Of the report, of its vehicle's places, of the tiles that it speaks of, and of the quarantine."""
    refused: list[Lock] = [QUARANTINE] if settled.state == "quarantined" else []
    places: list[Lock] = [("place", settled.claim.upload.vehicle)] if settled.place or settled.is_impossible else []
    return [*locks_of(settled.claim.upload), *inbox.locks_of(settled.rows), *refused, *places]


def row_of(upload: Upload, home: str, clock: QueueClock) -> dict[str, Any]:
    """A message as `insert_upload` takes it; the same bytes on the same key are known."""
    told = {name: getattr(upload, name) for name in Upload.__slots__}
    until = {"boot": clock.name, "lease_ns": clock.steady_ns() + HEAD_START_NS}
    sha = sha256(upload.key.encode() + b"\0" + upload.body).digest()
    return told | until | {"sha": sha, "home": home}


def any_claimable(c: SqlConnection, owner: str) -> bool:
    """Whether `claim` would find anything."""
    return bool(fetch(c, "any_fresh_upload", {"home": owner}) or fetch(c, "any_free_upload", _clock(c)))


def waiting(c: SqlConnection, vehicle: str | None, at_most: int) -> int:
    """How many uploads wait, of one vehicle only those that nobody has looked at; at most `at_most` are counted."""
    if vehicle is None:
        return int(fetch(c, "waiting_of_all", {"n": at_most})[0][0])
    return int(fetch(c, "waiting_of_vehicle", {"vehicle": vehicle, "n": at_most})[0][0])


def any_left_behind(c: SqlConnection) -> bool:
    """Whether an upload is free that was claimed before."""
    return bool(fetch(c, "any_upload_left_behind", _clock(c)))


def turns(c: SqlConnection, after: str) -> tuple[list[str], str]:
    """Vehicles whose uploads wait, and where to go on: no name comes first because of how it is spelt.

    Args:
        c: inside a transaction.
        after: where the last look has ended; "": begin with the first name.
    """
    found = [vehicle for (vehicle,) in fetch(c, "turns_of_uploads", {"n": MOST_TURNS, "after": after})]
    if len(found) == MOST_TURNS:
        return found, found[-1]
    if after:  # the first names come again
        left = {"n": MOST_TURNS - len(found), "after": ""}
        found += [vehicle for (vehicle,) in fetch(c, "turns_of_uploads", left) if vehicle < after]
    return found, ""


def others_lag(c: SqlConnection, owner: str) -> bool:
    """Whether what others have received has waited so much longer than what the owner has that it should help."""
    oldest, own = fetch(c, "oldest_fresh"), fetch(c, "oldest_fresh_of", {"home": owner})
    if not oldest or not own:
        return True
    now_ns = c.clock.steady_ns()
    longest_ns, own_ns = (now_ns + HEAD_START_NS - lease_ns for ((lease_ns,),) in (oldest, own))
    return bool(longest_ns > HEAD_START_NS + HELP_FACTOR * own_ns)


def claim(
    c: SqlConnection, owner: str, n: int, lease_s: float, vehicles: Sequence[str], *, helps: bool = True
) -> list[UploadClaim]:
    """Lease uploads of several vehicles in this order, of each the oldest first. One that was claimed before comes
    alone: it may be what ended its worker. Where the owner does not help others, only what it has received itself, or
    what others have left; where there is none, any.
    """
    rows = fetch(c, "free_uploads", _clock(c) | {"n": 1, "attempts": 1})
    if not rows and not helps:
        rows = _fresh(c, owner, n, _own(c, owner, vehicles), {"now": 0, "never": NEVER_NS})
    rows = rows or _fresh(c, owner, n, vehicles, {})
    return [_lease(c, owner, lease_s, *row) for row in rows]


def _own(c: SqlConnection, owner: str, vehicles: Sequence[str]) -> Sequence[str]:
    """Those of the vehicles of which the owner has received something; where very much waits, some that may be."""
    oldest = fetch(c, "oldest_of_home", {"home": owner, "n": MOST_OWN})
    own = {vehicle for (vehicle,) in oldest}
    return vehicles[:MOST_OWN_VEHICLES] if len(oldest) == MOST_OWN else [one for one in vehicles if one in own]


def _fresh(c: SqlConnection, owner: str, n: int, vehicles: Sequence[str], times: dict[str, int]) -> list[Row]:
    """Times: when a lease counts as ended."""
    found: list[Row] = []
    each = max(AT_ONCE_OF_VEHICLE, n // max(1, len(vehicles)))
    for vehicle in vehicles:
        wanted = _clock(c) | times | {"vehicle": vehicle, "home": owner, "n": min(each, n - len(found))}
        found += fetch(c, "fresh_uploads", wanted)
        if len(found) >= n:
            break
    return found


def _lease(c: SqlConnection, owner: str, lease_s: float, number: int, *row: Any) -> UploadClaim:
    *upload, attempts = row
    token = secrets.randbits(62)
    until = {"boot": c.clock.name, "lease_ns": c.clock.steady_ns() + round(lease_s * NS_PER_S)}
    post(c, "lease_upload", until | {"upload": number, "owner": owner, "token": token})
    return UploadClaim(number, Upload(*upload), owner, token, attempts + 1)


def postpone(c: SqlConnection, claim: UploadClaim, delay_s: float, *, blameless: bool) -> None:
    """Give an upload back, to be claimed again after `delay_s`; blameless: as if it had been claimed once only."""
    until = {"boot": c.clock.name, "lease_ns": c.clock.steady_ns() + round(delay_s * NS_PER_S)}
    post(c, "postpone_upload", until | {"upload": claim.number, "token": claim.token, "blameless": blameless})


def release(c: SqlConnection, owner: str) -> int:
    """Free the uploads that an owner has leased or received; how many they were."""
    return change(c, "release_uploads", {"owner": owner})


def settle(c: SqlConnection, settled: Settled, config: StoreConfig, timing: dict[str, Any]) -> bool:
    """Apply what a worker has made of an upload; False, and nothing is applied, when its lease is another's.

    Raises:
        IdTaken: another vehicle has a report with this id about one of the tiles.
        ImpossiblePlace: its vehicle cannot have been there.
    """
    claim, upload = settled.claim, settled.claim.upload
    rows, foreign = borders.apart(c, upload.form, settled.rows)
    journal_id = settled.rows[0].report_id if settled.rows else ""
    told = {"state": settled.state, "wanted": settled.wanted, "reason": settled.reason, "journal_id": journal_id}
    statement = "wait_for_flags" if settled.state == "early" else "settle_upload"
    put = inbox.begin_to_put(c, rows)
    if not change(c, statement, told | {"upload": claim.number, "token": claim.token}):
        return False
    if settled.place is not None and upload.vehicle:
        put_place(c, upload.vehicle, settled.place)
    if settled.is_impossible:
        post(c, "put_impossible", {"vehicle": upload.vehicle, "now": timing["now"], "why": settled.reason})
    _check_vehicles(c, rows, put(config, timing))
    borders.keep(c, foreign)
    if settled.first is not None:
        answered = {name: getattr(settled.first, name) for name in type(settled.first).__slots__}
        post(c, "answer_first_half", answered)
    if settled.state == "quarantined":
        row = {"sha": sha256(upload.body).digest(), "source": upload.key, "reason": settled.reason}
        post(c, "insert_quarantine", row | {"body": upload.body, "received_ns": timing["now"]})
        trim_quarantine(c, config.quarantine_bytes)
    if upload.form == "packed":
        post(c, "wake_gaussians", {"report_id": upload.report_id, "key": upload.key})
    if upload.form == "whole" and settled.state == "released":
        post(c, "release_flags", {"report_id": upload.report_id, "vehicle": upload.vehicle})
    return True


def _check_vehicles(c: SqlConnection, rows: Sequence[ReportRow], statuses: Sequence[PutStatus]) -> None:
    for row, status in zip(rows, statuses, strict=True):
        if status == "duplicate":
            place = {"layer": row.layer, "tile": row.tile.morton, "report_id": row.report_id, "part": row.part}
            ((vehicle,),) = fetch(c, "vehicle_of_report", place)
            if vehicle != row.vehicle:
                raise IdTaken(f"report {row.report_id} of {row.vehicle}: its id is one of {vehicle}, tile {row.tile}")


def first_halves(c: SqlConnection, key: str, report_id: str) -> list[FirstHalf]:
    """The flags that have come under a report id on a key: of one vehicle, unless another uses the same id."""
    return [FirstHalf(*row) for row in fetch(c, "first_halves", {"key": key, "report_id": report_id})]


def parts(c: SqlConnection, layer: str, report_id: str, tiles: Iterable[TileId]) -> list[ReportRow]:
    """What the journal holds under a report id about these tiles, in this order: parts 0."""
    wanted = ({"layer": layer, "tile": tile.morton, "report_id": report_id} for tile in tiles)
    rows: list[Row] = [row for place in wanted for row in fetch(c, "report_part", place)]
    return [ReportRow(row[0], row[1], TileId(row[2]), *row[3:]) for row in rows]


def statuses(c: SqlConnection, vehicle: str, report_ids: Iterable[str]) -> list[UploadStatus]:
    """How far a vehicle's reports have come, those of which the store holds anything."""
    found = []
    for report_id in report_ids:
        rows = fetch(c, "upload_status", {"vehicle": vehicle, "report_id": report_id})
        found += [UploadStatus(report_id, *row) for row in rows]
    return found


def counts(c: SqlConnection) -> UploadCounts:
    """How many there are, and how long the oldest has waited."""
    by_state = {str(state): int(n) for state, n in fetch(c, "upload_counts")}
    return UploadCounts(by_state, fetch(c, "oldest_upload")[0][0])


def forget(c: SqlConnection, before_ns: int) -> int:
    """Forget uploads received before a time of which nothing is expected any more; how many they were."""
    return change(c, "forget_uploads", {"before_ns": before_ns})


def _clock(c: SqlConnection) -> dict[str, Any]:
    now_ns = c.clock.steady_ns()
    return {"boot": c.clock.name, "now": now_ns, "never": now_ns + LONGEST_LEASE_NS}
