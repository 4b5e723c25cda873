"""What came of a chaos run, from what the clients hold and what stands in the store; nothing is asked of running code.

Acknowledged is what an outbox calls so. It is in the journal exactly once when each tile of the report has one row of
flags that says what the vehicle said, whatever id it stands under; and a row of Gaussians, where Gaussians were
acknowledged. A row that no outbox knows is one too many.
"""

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gnd.deploy.chaos.clients import Receipt, held_by, read_receipts
from gnd.deploy.chaos.street import LAYER
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.tile_store.check import check_store
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.location import StoreLocation
from gnd.tile_store.signatures import GOOD, signatures
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.vehicle_agent.link.outbox import Outbox

MOST_NAMED: Final = 20
_UNREAD: Final = ("waiting", "early")

Mark = tuple[str, int]
"""Vehicle and time of a report: what it is, under whatever id."""


@dataclass(frozen=True, slots=True)
class KeptReports:
    """A report as its client holds it: its state in the outbox, and how often its Gaussians were acknowledged."""

    report: ChangeReport
    state: str
    gaussians: int = 0

    @property
    def mark(self) -> Mark:
        """What it is."""
        return self.report.vehicle, self.report.first_ns


@dataclass(slots=True)
class Findings:
    """What was found; lists name the first few.

    Attributes:
        reports: that clients have put into their outboxes.
        acknowledged: of them.
        versions: merged versions in the store.
        received: tiles that clients received.
        lost: acknowledged reports that are not in the journal, or not as they were said.
        doubled: reports that are in the journal more than once, or that nobody has sent.
        torn_tiles: receipts that did not decode, or are not what the store has under that number.
        stuck_tiles: tiles with work that has not come to an end.
        unreleased: reports of which clients still wait for word.
        signed: versions that a publisher of the fleet answers for, where all are to be signed.
        damages: what `gnd map check` finds, and versions that nobody answers for where all are to be signed.
        identical_map: whether `gnd map verify` computes the newest version of every tile alike.
    """

    reports: int = 0
    acknowledged: int = 0
    versions: int = 0
    received: int = 0
    signed: int = 0
    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    torn_tiles: list[str] = field(default_factory=list)
    stuck_tiles: list[str] = field(default_factory=list)
    unreleased: list[str] = field(default_factory=list)
    damages: list[str] = field(default_factory=list)
    identical_map: bool = False
    verify: dict[str, int] = field(default_factory=dict)

    @property
    def failures(self) -> list[str]:
        """What must not be, in words; a run in which nothing happened has failed, too."""
        named = ("lost", "doubled", "torn_tiles", "stuck_tiles", "unreleased", "damages")
        found = [f"{len(getattr(self, name))} {name.replace('_', ' ')}" for name in named if getattr(self, name)]
        if not self.identical_map:
            found.append(f"gnd map verify: {self.verify}")
        nothing = [name for name in ("acknowledged", "versions", "received") if not getattr(self, name)]
        return found + [f"nothing {name}: nothing was tested" for name in nothing]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able: numbers, and by name the first of what was found."""
        named = ("lost", "doubled", "torn_tiles", "stuck_tiles")
        return {
            "acknowledged": self.acknowledged,
            **{name: len(getattr(self, name)) for name in named},
            "identical_map": self.identical_map,
            "reports": self.reports,
            "versions": self.versions,
            "signed": self.signed,
            "received_tiles": self.received,
            "unreleased": len(self.unreleased),
            "damages": len(self.damages),
            "verify": self.verify,
            "found": {name: getattr(self, name)[:MOST_NAMED] for name in (*named, "unreleased", "damages")},
        }


def look(
    store: Path,
    outboxes: Iterable[Path],
    receipts: Iterable[Path],
    verify: Callable[[Path], tuple[dict[str, int], bool]] | None = None,
) -> Findings:
    """Everything about a cloud that has ended.

    Args:
        store: of the cloud.
        outboxes: of its vehicles.
        receipts: of its followers.
        verify: computes the map anew; by default `gnd map verify` does.
    """
    found = Findings()
    kept = [one for path in outboxes for one in read_outbox(path)]
    with SqliteStore(store, create=False) as opened:
        compare_reports(found, opened, kept)
        compare_tiles(found, opened, [one for path in receipts for one in read_receipts(path)])
        find_stuck(found, opened)
    found.damages = [f"{one.kind} {one.name}: {one.why}" for one in check_store(store, all_versions=True).damages]
    found.verify, found.identical_map = (verify or verified)(store)
    return found


def read_outbox(path: Path) -> list[KeptReports]:
    """What a vehicle holds."""
    outbox = Outbox(path)
    try:
        states = outbox.states()
        bodies = {report_id: outbox.body_of(report_id) or b"" for report_id in states}
        answers = outbox.answers()
    finally:
        outbox.close()
    return [KeptReports(ChangeReport.decode(bodies[one]), state, answers[one]) for one, state in states.items()]


def compare_reports(found: Findings, store: SqlStore, kept: Sequence[KeptReports]) -> None:
    """Is every acknowledged report in the journal once, and nothing else?"""
    sent = {one.mark: one for one in kept}
    acknowledged = held_by({one.report.report_id: one.state for one in kept})
    found.reports, found.acknowledged = len(kept), len(acknowledged)
    rows: Counter[tuple[Mark, int, int]] = Counter()  # of which report, about which tile, which part
    said: dict[tuple[Mark, int], TileChange] = {}
    for row in store.reports(LAYER):
        report = ChangeReport.decode(row.body)
        mark = report.vehicle, report.first_ns
        if mark not in sent:
            found.doubled.append(f"{row.report_id} on {row.tile.path}: no client has sent it")
            continue
        rows[mark, row.tile.morton, row.part] += 1
        if row.part == 0:
            said[mark, row.tile.morton] = report.tiles[0]
    for ((vehicle, first_ns), morton, part), n in rows.items():
        if n > 1:
            found.doubled.append(f"{vehicle} {first_ns} on {TileId(morton).path}: {n} rows of part {part}")
    for one in kept:
        if one.report.report_id in acknowledged:
            found.lost += _missing(one, rows, said)
        else:
            found.unreleased.append(f"{one.report.report_id} of {one.report.vehicle}: {one.state}")
    found.unreleased += [f"{one.report.report_id}: {one.state}" for one in kept if one.state == "stored"]


def _missing(
    one: KeptReports, rows: Counter[tuple[Mark, int, int]], said: dict[tuple[Mark, int], TileChange]
) -> list[str]:
    """What of an acknowledged report is not in the journal, in one line."""
    name = f"{one.report.report_id} of {one.report.vehicle}"
    absent = [change.tile for change in one.report.tiles if not rows[one.mark, change.tile.morton, 0]]
    if absent:
        return [f"{name}: {len(absent)} of {len(one.report.tiles)} tiles, first {absent[0].path}"]
    other = [change for change in one.report.tiles if not _agree(change, said[one.mark, change.tile.morton])]
    if other:
        return [f"{name}: {len(other)} tiles say something else, first {other[0].tile.path}"]
    if one.gaussians and not any(rows[one.mark, change.tile.morton, 1] for change in one.report.tiles):
        return [f"{name}: its Gaussians"]
    return []


def _agree(change: TileChange, journaled: TileChange) -> bool:
    """The same voxels, of the same classes, against the same version."""
    ids = change.changed.voxel_id.tolist(), change.change_class.tolist(), change.base_sha
    return ids == (journaled.changed.voxel_id.tolist(), journaled.change_class.tolist(), journaled.base_sha)


def compare_tiles(found: Findings, store: SqlStore, receipts: Sequence[Receipt]) -> None:
    """Did every tile that came have the content that the store has under its number?"""
    found.received = len(receipts)
    shas: dict[tuple[TileId, int], bytes] = {}
    for head in store.heads(LAYER):
        for info in store.history(LAYER, head.tile):
            shas[head.tile, info.version] = info.sha
            found.versions += info.kind == "merged"
    for one in receipts:
        kept = shas.get((one.tile, one.version))
        if not one.found_sha:
            found.torn_tiles.append(f"{one.tile.path} version {one.version}, by {one.how}: it did not decode")
        elif one.found_sha != kept or one.sha != kept:
            found.torn_tiles.append(
                f"{one.tile.path} version {one.version}, by {one.how}: {one.found_sha.hex()[:16]}, the store has"
                f" {kept.hex()[:16] if kept else 'no such version'}"
            )


def find_stuck(found: Findings, store: SqlStore) -> None:
    """Is anything left to do?"""
    found.stuck_tiles += [f"{TileId(tile).path}: {why}" for tile, why in store.look(_unmerged)]
    waiting = {name: n for name, n in store.upload_counts().by_state.items() if name in _UNREAD}
    found.stuck_tiles += [f"{n} uploads are {name}" for name, n in waiting.items()]
    found.stuck_tiles += [f"{one.tile.path}: version {one.version} is not announced" for one in store.notices()]


def find_unsigned(found: Findings, store: SqlStore, identity: Path) -> None:
    """Has a publisher of the fleet signed every version? What a vehicle knows is enough to tell."""
    answered = list(signatures(store, Publishers(identity), LAYER, all_versions=True))
    wrong = [one for one in answered if one.status != GOOD]
    found.signed = len(answered) - len(wrong)
    found.damages += [f"{one.tile.path} version {one.version}: {one.status}: {one.why}" for one in wrong]


def _unmerged(c: SqlConnection) -> list[tuple[int, str]]:
    queued = [(int(tile), str(why)) for tile, why in fetch(c, "queued_tiles")]
    known = {tile for tile, _ in queued}
    rows = fetch(c, "unmerged_reports")
    forgotten = [(int(tile), f"{n} reports are in no version") for tile, n in rows if tile not in known]
    return queued + forgotten


def verified(store: StoreLocation) -> tuple[dict[str, int], bool]:
    """What `gnd map verify` says, in a process of its own: its counts, and whether all that was merged is the same."""
    command = [sys.executable, "-m", "gnd.deploy.cli", "map", "verify", str(store), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - nothing in it is given
    try:
        told = json.loads(done.stdout)
    except ValueError:
        return {"exit_status": done.returncode}, False
    counts = {name: int(told[name]) for name in ("same", "given", "unknown", "differs")}
    return counts, bool(told["identical"]) and counts["same"] > 0 and not counts["unknown"]
