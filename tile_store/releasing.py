"""Settling trials: released to all, withdrawn, paused; each in one transaction, written down with who and why."""

import json
from collections.abc import Mapping
from typing import Any

from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store import sql_trials as trials
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, change, fetch
from gnd.tile_store.errors import StoreError
from gnd.tile_store.provenance import Provenance, decode_provenance
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import VersionTrial

Verdict = Mapping[str, Any]


def release(store: SqlStore, trial: VersionTrial, who: str, why: str, verdict: Verdict | None = None) -> bool:
    """The version is everybody's from now on, and its notice goes out; False: the trial was settled already."""

    def work(c: SqlConnection, now: int) -> bool:
        with catalogs.changing(c, store.signing, trial.layer, trial.tile):
            if not trials.set_state(c, trial, "released", _text(trial, verdict), now):
                return False
        place = {"layer": trial.layer, "tile": trial.tile.morton, "version": trial.version}
        change(c, "insert_notice", place | {"created_ns": now})
        trials.steer(c, trial.place, who, "released", why, now)
        return True

    return store.transact(work)


def withdraw(store: SqlStore, trial: VersionTrial, who: str, why: str, verdict: Verdict | None = None) -> bool:
    """The content before the trial becomes the next version, and the reports behind the trial are doubted; False: the
    trial was settled already.

    It is a rollback: a new epoch begins with it, in which nothing counts that was reported before.
    """
    report_ids = behind(store, trial)

    def work(c: SqlConnection, now: int) -> bool:
        with catalogs.changing(c, store.signing, trial.layer, trial.tile, "rollback"):
            if not trials.set_state(c, trial, "withdrawn", _text(trial, verdict), now):
                return False
            trials.doubt(c, trial.place, report_ids, now)
            versions.roll_back_released(c, trial.layer, trial.tile, trial.base_version, now, store.signing)
        trials.steer(c, trial.place, who, "withdrawn", why, now)
        return True

    return store.transact(work)


def hold(store: SqlStore, trial: VersionTrial, who: str, why: str, *, paused: bool) -> bool:
    """Nothing is decided until somebody does, or (not paused) by what vehicles tell; False: it was settled already."""

    def work(c: SqlConnection, now: int) -> bool:
        if not trials.set_state(c, trial, "paused" if paused else "trial", trial.verdict, now):
            return False
        trials.steer(c, trial.place, who, "paused" if paused else "resumed", why, now)
        return True

    return store.transact(work)


def note_verdict(store: SqlStore, trial: VersionTrial, verdict: Verdict) -> None:
    """Keep how far a trial has come, for who looks."""
    text = _text(trial, verdict)
    if text != trial.verdict and trial.state != "paused":
        store.transact(lambda c, now: trials.set_state(c, trial, trial.state, text, now))


def clear(store: SqlStore, layer: str, tile: TileId, who: str, why: str) -> int:
    """The doubted reports about a tile are believed again, and the tile waits to be merged; how many were doubted.

    Raises:
        StoreError: none are.
    """

    def work(c: SqlConnection, now: int) -> int:
        doubted = [one.version for one in trials.doubted_reports(c, layer, tile) if one.cleared_ns is None]
        cleared = trials.clear_doubts(c, layer, tile, who, now)
        if not cleared:
            raise StoreError(f"no report about tile {tile.path} of layer {layer} is doubted")
        trials.steer(c, (layer, tile, max(doubted)), who, "cleared", why, now)
        inbox.merge_again(c, layer, tile, store.timing())
        return cleared

    return store.transact(work)


def behind(store: SqlStore, trial: VersionTrial) -> tuple[str, ...]:
    """The reports that the voxels come from in which a version on trial differs from the one before; where the store
    does not know them by voxel, all that the version has and the one before has not.
    """
    of_new, of_old = (_provenance(store, trial, version) for version in (trial.version, trial.base_version))
    by_voxel = of_new.of_voxels()
    try:
        changed = changed_voxels(store, trial)
    except SchemaError:  # a damaged body is no reason to leave it with anybody
        changed = frozenset()
    found = {report_id for voxel in changed for report_id in by_voxel.get(voxel, ())}
    # a voxel that fell back to what it was names no report of its own: those that are new have done it
    return tuple(sorted(found or set(of_new.report_ids) - set(of_old.report_ids) or of_new.report_ids))


def changed_voxels(store: SqlStore, trial: VersionTrial) -> frozenset[int]:
    """The voxels in which a version on trial differs from the one before."""
    old = store.get(trial.layer, trial.tile, trial.base_version)
    new = store.get(trial.layer, trial.tile, trial.version)
    if old is None or new is None:
        return frozenset()
    return _differing(old.decode(), new.decode())


def _differing(old: AnyTile, new: AnyTile) -> frozenset[int]:
    if isinstance(old, FeatureTile) or isinstance(new, FeatureTile):
        raise StoreError("feature layers have no trials")
    delta = diff(old.gaussians, new.gaussians)
    return frozenset(delta.removed.tolist()) | frozenset(delta.put.voxel_id.tolist())


def _provenance(store: SqlStore, trial: VersionTrial, version: int) -> Provenance:
    place = {"layer": trial.layer, "tile": trial.tile.morton, "version": version}
    rows = store.look(lambda c: fetch(c, "provenance", place))
    if not rows:
        raise StoreError(f"tile {trial.tile.path} of layer {trial.layer} has no version {version}")
    return decode_provenance(rows[0][0])


def _text(trial: VersionTrial, verdict: Verdict | None) -> str:
    return trial.verdict if verdict is None else json.dumps(verdict, sort_keys=True)
