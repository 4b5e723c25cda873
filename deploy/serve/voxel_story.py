"""One voxel: what it is, in which versions it changed, and which reports said so, with their evidence."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from ulid import ULID

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import SchemaError
from gnd.tile_store.errors import UnknownVersion
from gnd.tile_store.store import Store
from gnd.tile_store.values import ReportRow, StoredTile

_NS_PER_MS: Final = 1_000_000
_ALL_WINDOWS: Final = 2**31 - 1
COUNTERS: Final = ("blocked_inside", "blocked_outside", "in_empty", "passed_inside")
"""Rays of a voxel, as `TileChange.evidence` counts them."""


@dataclass(frozen=True, slots=True)
class _StoryStep:
    """A version in which the voxel changed, and to what."""

    stored: StoredTile
    what: str
    reports: tuple[str, ...]


def voxel_story(store: Store, layer: str, tile: TileId, voxel: int, version: int | None) -> dict[str, Any]:
    """What a voxel is in a version, and how it came to be that.

    Args:
        store: to read.
        layer: of Gaussians.
        tile: which tile.
        voxel: which voxel of it.
        version: None: the newest.

    Returns:
        `gaussian` (None: there is none), and `steps`, oldest first: version, time, what happened to the voxel (base,
        new, modified, deleted), who merged it, and the reports that say so, with vehicle, time, class and rays.

    Raises:
        UnknownVersion: no such version.
    """
    stored = store.get(layer, tile, version)
    if stored is None:
        raise UnknownVersion(f"tile {tile} of layer {layer!r} has no version {version if version else 'at all'}")
    gaussians = stored.decode_gaussians().gaussians.select([voxel])
    lat, lon, height = VoxelGrid.of(tile).centre_geodetic(np.array([voxel], np.int32))
    steps = list(_steps(store, layer, tile, voxel, stored.version))
    rows = _rows(store, layer, tile) if any(step.reports for step in steps) else {}
    return {
        "tile": tile.morton,
        "path": tile.path,
        "voxel": voxel,
        "version": stored.version,
        "lat_deg": float(np.degrees(lat[0])),
        "lon_deg": float(np.degrees(lon[0])),
        "height_m": float(height[0]),
        "gaussian": _gaussian(gaussians),
        "steps": [_told(step, rows, tile, voxel) for step in steps],
    }


def _gaussian(found: Gaussians) -> dict[str, Any] | None:
    if not len(found):
        return None
    variance = np.linalg.eigvalsh(found.full_cov()[0])[::-1]
    return {
        "points": int(found.count[0]),
        "cells": int(found.cells[0]),
        "mean_m": [round(float(one), 4) for one in found.mean_m[0]],
        "sd_m": [round(float(one), 4) for one in np.sqrt(np.maximum(variance, 0.0))],
    }


def _steps(store: Store, layer: str, tile: TileId, voxel: int, newest: int) -> Iterator[_StoryStep]:
    before = Gaussians.empty()
    is_first = True
    for line in store.history(layer, tile):
        if line.version > newest:
            return
        stored = store.get(layer, tile, line.version)
        if stored is None:
            continue
        now = stored.decode_gaussians().gaussians.select([voxel])
        delta = diff(before, now)
        if len(delta.removed) or len(delta.put) or is_first:
            what = "deleted" if len(delta.removed) else "modified" if len(before) else "new" if len(now) else "empty"
            reports = store.voxel_provenance(layer, tile, line.version).get(voxel, ())
            yield _StoryStep(stored, "surveyed" if line.kind == "base" and len(now) else what, reports)
        before, is_first = now, False


def _rows(store: Store, layer: str, tile: TileId) -> dict[str, ReportRow]:
    """The reports about a tile, by id; a second half stands for the first."""
    return {row.report_id: row for row in store.reports_of_windows(layer, tile, 0, _ALL_WINDOWS, _ALL_WINDOWS)}


def _told(step: _StoryStep, rows: dict[str, ReportRow], tile: TileId, voxel: int) -> dict[str, Any]:
    stored = step.stored
    return {
        "version": stored.version,
        "kind": stored.kind,
        "what": step.what,
        "created_ms": stored.created_ns // _NS_PER_MS,
        "merger": stored.merger,
        "reports": [_report(one, rows.get(one), tile, voxel) for one in step.reports],
    }


def _report(report_id: str, row: ReportRow | None, tile: TileId, voxel: int) -> dict[str, Any]:
    told: dict[str, Any] = {
        "id": report_id,
        "vehicle": None if row is None else row.vehicle,
        "driven_ms": ULID.from_str(report_id).milliseconds,
        "says": None,
        "rays": None,
    }
    if row is None:
        return told
    with suppress(SchemaError):  # a damaged body is the merger's to tell
        for change in ChangeReport.decode(row.body).tiles:
            at = np.flatnonzero(change.changed.voxel_id == voxel)
            if change.tile == tile and len(at):
                told["says"] = ChangeClass(int(change.change_class[at[0]])).name.lower()
                told["rays"] = dict(zip(COUNTERS, change.evidence[at[0]].tolist(), strict=True))
    return told
