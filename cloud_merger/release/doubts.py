"""Reports behind a version that was withdrawn: cleared by a later version that passed its trial, or by an operator."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from gnd.cloud_merger.statements import Kind, states_at
from gnd.cloud_merger.stored import said
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store import clocks, releasing
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import DoubtedReport, VersionTrial
from gnd.tile_store.values import ReportRow

CONFIRMED_SHARE: Final = 0.5
"""Of what a withdrawn version had changed: so much of it in a version that passed its trial clears its reports."""
ALIKE_STATES: Final = 0.5
"""Similarity of two states of a voxel that say the same."""


def clear_confirmed(store: SqlStore, released: VersionTrial, who: str) -> int:
    """Clear the doubts of a tile whose withdrawn version a released one confirms; how many reports that is.

    They are not merged again: the released version says what they said. What an operator doubts an operator clears.
    """
    layer, tile = released.layer, released.tile
    doubted = {one.version for one in _doubted(store, layer, tile)}
    before = [one for one in store.look(lambda c: trials.of_tile(c, layer, tile)) if one.version in doubted]
    if len(before) < len(doubted) or not before or not all(_is_confirmed(store, one, released) for one in before):
        return 0
    return releasing.clear(store, layer, tile, who, f"version {released.version} passed its trial and says the same")


def clear_and_reenter(
    store: SqlStore,
    place: tuple[str, TileId],
    who: str,
    why: str,
    now_ns: Callable[[], int] = clocks.day_ns,
) -> int:
    """Clear the doubts of a tile on somebody's word: the reports count again, as if they came now, under new ids (the
    old ones belong to an epoch that is over). How many were doubted.

    Args:
        store: of the map.
        place: layer and tile.
        who: clears them.
        why: for who looks later.
        now_ns: the time of day, int ns UTC.

    Raises:
        StoreError: none are.
    """
    layer, tile = place
    rows = list(_reentered(store, layer, tile, now_ns()))
    cleared = releasing.clear(store, layer, tile, who, why)
    store.put_reports(rows)
    return cleared


def _reentered(store: SqlStore, layer: str, tile: TileId, now_ns: int) -> Iterator[ReportRow]:
    """The doubted reports that retention has left, each whole: of one in two parts the second."""
    for one in _doubted(store, layer, tile):
        parts = _parts(store, layer, tile, one.report_id)
        if not parts:
            continue
        try:
            report = said(parts[-1].body)
        except SchemaError:
            continue  # no merge could read it, either
        named = deterministic_report_id(report.first_ns // 1_000_000, one.report_id, "cleared", str(one.since_ns))
        yield ReportRow(
            report_id=named,
            layer=layer,
            tile=tile,
            vehicle=one.vehicle,
            received_ns=now_ns,
            body=replace(report, report_id=named).encode(),
            base_sha=parts[-1].base_sha,
        )


def _parts(store: SqlStore, layer: str, tile: TileId, report_id: str) -> list[ReportRow]:
    return store.look(lambda c: inbox.of_report(c, layer, tile, report_id))


def _doubted(store: SqlStore, layer: str, tile: TileId) -> list[DoubtedReport]:
    return [one for one in store.look(lambda c: trials.doubted_reports(c, layer, tile)) if one.cleared_ns is None]


def _is_confirmed(store: SqlStore, withdrawn: VersionTrial, released: VersionTrial) -> bool:
    """Whether most of what a withdrawn version had changed is so in the released one."""
    changed = np.array(sorted(releasing.changed_voxels(store, withdrawn)), np.int32)
    then = store.get(withdrawn.layer, withdrawn.tile, withdrawn.version)
    now = store.get(released.layer, released.tile, released.version)
    if not len(changed) or then is None or now is None:
        return False
    a, b = (states_at(one.decode_gaussians().gaussians, changed, Kind.QUOTED) for one in (then, now))
    alike = similarity(a["count"] > 0, a["mean_m"], a["cov_m2"], b["count"] > 0, b["mean_m"], b["cov_m2"])
    return float((alike >= ALIKE_STATES).mean()) >= CONFIRMED_SHARE
