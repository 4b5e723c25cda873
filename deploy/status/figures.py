"""What `gnd status` looks at: figures of a store, of the disk that it lies on, and of a certificate."""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gnd.tile_store import sql_trials as trials
from gnd.tile_store.connection import fetch
from gnd.tile_store.location import StoreLocation, file_of, shown
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.status import naming_line, waiting_totals
from gnd.tile_store.values import QueueState, ShardSeen


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """Where a store lies: the file and its log, bytes, and what is free on that disk; None: in a database."""

    store_bytes: int
    free_bytes: int | None
    folder: str = ""


@dataclass(frozen=True, slots=True)
class CloudFigures:
    """How the cloud over one store stands.

    Attributes:
        source: the store, for people, without a password.
        at_ns: when it was looked at, UTC.
        shards: those that have joined and not left.
        tiles: of all layers. parts: report parts that were ever acknowledged. parts_waiting: those no merge has read.
        tiles_to_merge, tiles_set_aside: tiles in the queue, tiles that cannot be merged.
        queue: how far merging lags behind.
        uploads: acknowledged uploads by state.
        waiting: tiles and voxels that wait for confirmation, see `waiting_totals`.
        on_trial, paused: versions that a share of the fleet gets first; those of them that somebody paused.
        not_counted: vehicles whose reports do not count, with the reason.
        to_check: a line for each vehicle whose mount or clock should be looked at.
        disk: where it lies.
        certificate_s: how long this program's own certificate holds, s; None: it has none.
    """

    source: str
    at_ns: int
    shards: tuple[ShardSeen, ...]
    tiles: int
    parts: int
    parts_waiting: int
    tiles_to_merge: int
    tiles_set_aside: int
    queue: QueueState
    uploads: Mapping[str, int]
    waiting: Mapping[str, int]
    on_trial: int
    paused: int
    not_counted: Mapping[str, str]
    to_check: tuple[str, ...]
    disk: DiskRoom
    certificate_s: float | None = None

    @property
    def alive(self) -> tuple[str, ...]:
        """Names of the shards that were heard of lately."""
        return tuple(one.owner for one in self.shards if one.is_alive)

    @property
    def silent(self) -> tuple[str, ...]:
        """Names of those that have gone without saying so."""
        return tuple(one.owner for one in self.shards if not one.is_alive)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        lags = {"p50": self.queue.lag_s(0.5), "p95": self.queue.lag_s(0.95), "max": self.queue.lag_s(1.0)}
        told = {name: value for name, value in asdict(self).items() if name not in ("queue", "shards")}
        return told | {
            "shards": [asdict(one) | {"is_alive": one.is_alive} for one in self.shards],
            "queue": {"overdue_s": self.queue.overdue_s, "waiting_s": self.queue.waiting_s, "lag_s": lags},
            "quarantine": {"messages": self.queue.quarantined, "bytes": self.queue.quarantined_bytes},
        }


def look_at(store: SqlStore, location: StoreLocation, identity: Path | None = None) -> CloudFigures:
    """Look at a store once; nothing is changed.

    Args:
        store: opened.
        location: where it is.
        identity: folder of this program's own certificate, None without.
    """
    tiles, parts, waiting, dirty, aside = store.look(lambda c: fetch(c, "metrics")[0])
    open_trials = store.look(trials.all_open)
    return CloudFigures(
        source=shown(location),
        at_ns=time.time_ns(),
        shards=tuple(store.shards()),
        tiles=tiles,
        parts=parts,
        parts_waiting=waiting,
        tiles_to_merge=dirty,
        tiles_set_aside=aside,
        queue=store.queue_state(),
        uploads=dict(store.upload_counts().by_state),
        waiting=waiting_totals(store),
        on_trial=len(open_trials),
        paused=sum(one.state == "paused" for one in open_trials),
        not_counted={one.vehicle: one.why for one in store.vehicle_trusts() if one.is_quarantined},
        to_check=tuple(naming_line(one) for one in store.vehicle_accounts() if one.is_named),
        disk=_disk(store, file_of(location)),
        certificate_s=None if identity is None else _left_s(identity),
    )


def _disk(store: SqlStore, file: Path | None) -> DiskRoom:
    used = sum(store.sizes().values())
    if file is None:
        return DiskRoom(used, None)
    return DiskRoom(used, store.disk_free_bytes(), str(file.absolute().parent))


def _left_s(identity: Path) -> float:
    from gnd.fleet_bus.identity.folder import load_identity  # loads cryptography

    return load_identity(identity).left_s()
