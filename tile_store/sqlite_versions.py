"""Tile versions in SQLite: each function runs inside the caller's transaction."""

from dataclasses import dataclass
from typing import Any

import apsw

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sqlite_accounts as accounts
from gnd.tile_store import sqlite_confirmation as confirmation
from gnd.tile_store import sqlite_inbox as inbox
from gnd.tile_store import sqlite_journal as journal
from gnd.tile_store import sqlite_refuted as refuted
from gnd.tile_store import sqlite_trials as trials
from gnd.tile_store import sqlite_trust as trust
from gnd.tile_store.errors import StoreError, UnknownReports, UnknownVersion
from gnd.tile_store.provenance import NOTHING, Provenance, encode_provenance
from gnd.tile_store.sqlite_connection import change, fetch
from gnd.tile_store.values import ClosedWindow, Content, GcResult, Publication, PublishResult, StoredTile, VersionKind


@dataclass(frozen=True, slots=True)
class _Head:
    version: int
    epoch: int
    sha: bytes


@dataclass(frozen=True, slots=True)
class _Origin:
    """Why a version is made, by whom, from which reports."""

    kind: VersionKind
    merger: str = ""
    provenance: Provenance = NOTHING


def publish(
    c: apsw.Connection, publication: Publication, content: Content | None, timing: dict[str, Any]
) -> PublishResult:
    """One publication: fence, compare-and-swap of the head, consumption of the reports."""
    claim = publication.claim
    head = _head(c, claim.layer, claim.tile)
    if not inbox.holds(c, claim):
        return PublishResult("stale", head.version)
    is_old = head.version != publication.base_version or trust.is_outdated(c, claim.layer, publication.basis)
    if is_old or trials.open_trial(c, claim.layer, claim.tile) is not None:
        inbox.postpone(c, claim, timing["steady"])  # ready at once, against the head as it is now
        return PublishResult("stale", head.version)
    _check_reports(c, publication)
    result = PublishResult("unchanged", head.version)
    if content is not None and content.sha != head.sha:
        provenance = Provenance.of(publication.report_ids, publication.voxel_reports)
        origin = _Origin(publication.reason, claim.owner, provenance)
        result = PublishResult("published", _append(c, claim.layer, claim.tile, content, origin, timing["now"]))
        if publication.trial is not None and head.version and not is_feature_layer(claim.layer):
            pair = head.version, result.version
            trials.begin(c, claim.layer, claim.tile, pair, publication.trial, timing["now"])
    basis = publication.basis
    if basis is not None and result.status == "published":
        journal.put_basis(c, claim.layer, claim.tile, result.version, basis)
    if publication.memory is not None and basis is not None:
        how = ClosedWindow(basis.named, basis.parameters)
        closed = dict.fromkeys(publication.closed, how)
        journal.keep(c, claim.layer, claim.tile, head.epoch, publication.memory, closed)
    is_news = inbox.consume(c, claim, claim.seq if basis is None else basis.seq, result.version, timing)
    if publication.waiting is not None:
        confirmation.keep(c, claim.layer, claim.tile, publication.waiting)
    accounts.put_courses(c, claim.layer, claim.tile, publication.courses)
    _put_tests(c, publication, timing, is_news)
    return result


def _put_tests(c: apsw.Connection, publication: Publication, timing: dict[str, Any], is_news: bool) -> None:
    """The accounts of the vehicles, and which of their reports about features are refuted now."""
    claim, tests = publication.claim, publication.shift_tests
    vehicles = {test.vehicle for test in tests} if is_feature_layer(claim.layer) else set()
    before = refuted.refuted(c, claim.layer, vehicles)
    accounts.put_tests(c, claim.layer, claim.tile, tests, timing)
    trust.put_tests(c, claim.layer, claim.tile, publication.agreement_tests, timing, is_news)
    refuted.merge_again(c, claim.layer, before, refuted.refuted(c, claim.layer, vehicles), timing)


def put_base(
    c: apsw.Connection,
    layer: str,
    tile: TileId,
    content: Content,
    kind: VersionKind,
    now: int,
    surveyed_ns: int | None = None,
) -> PublishResult:
    """Import a tile: a new epoch, unless the head is an epoch of the same content."""
    head = _head(c, layer, tile)
    is_known = bool(head.version) and head.version == head.epoch and head.sha == content.sha
    version = head.version if is_known else _append(c, layer, tile, content, _Origin(kind), now)
    if surveyed_ns is not None:
        row = {"layer": layer, "tile": tile.morton, "version": version, "surveyed_ns": surveyed_ns}
        change(c, "put_survey", row)
    return PublishResult("unchanged" if is_known else "published", version)


def rollback(c: apsw.Connection, layer: str, tile: TileId, version: int, now: int) -> StoredTile:
    """Publish the next version with the body of an older one."""
    old = stored(c, "stored_version", layer, tile, version=version)
    if old is None:
        newest = _head(c, layer, tile).version
        raise UnknownVersion(f"tile {tile.path} of layer {layer} has no version {version} (newest: {newest})")
    _append(c, layer, tile, Content(old.sha, old.codec_id, old.body), _Origin("rollback"), now)
    current = stored(c, "stored_head", layer, tile)
    assert current is not None
    return current


def stored(c: apsw.Connection, statement: str, layer: str, tile: TileId, **values: int | bytes) -> StoredTile | None:
    """The version that one of the `stored_…` statements finds."""
    rows = fetch(c, statement, {"layer": layer, "tile": tile.morton, **values})
    return StoredTile(rows[0][0], TileId(rows[0][1]), *rows[0][2:]) if rows else None


def sha_of(c: apsw.Connection, layer: str, tile: TileId, version: int) -> bytes:
    """The hash of a version; empty: there is none."""
    rows = fetch(c, "sha_of_version", {"layer": layer, "tile": tile.morton, "version": version})
    return rows[0][0] if rows else b""


def epoch_of(c: apsw.Connection, layer: str, tile: TileId) -> int:
    """The latest version of a tile that is a base or a rollback; 0 when there is none."""
    return _head(c, layer, tile).epoch


def collect(c: apsw.Connection, keep_versions: int) -> GcResult:
    """Remove versions older than the newest `keep_versions` of each tile, but for epochs and what reports cite."""
    sizes: list[int] = []
    for layer, morton in fetch(c, "tiles_with_history", {"keep": keep_versions}):
        head = _head(c, layer, TileId(morton))
        wanted = {"layer": layer, "tile": morton, "epoch": head.epoch, "oldest": head.version - keep_versions + 1}
        folded = journal.folded(c, layer, TileId(morton), head.epoch)
        sizes += [size for (size,) in fetch(c, "delete_old_versions", wanted | {"folded": folded})]
    return GcResult(len(sizes), sum(sizes))


def _head(c: apsw.Connection, layer: str, tile: TileId) -> _Head:
    rows = fetch(c, "head", {"layer": layer, "tile": tile.morton})
    return _Head(*rows[0]) if rows else _Head(0, 0, b"")


def _append(c: apsw.Connection, layer: str, tile: TileId, content: Content, origin: _Origin, now: int) -> int:
    head = _head(c, layer, tile)
    version = head.version + 1
    row: dict[str, Any] = {
        "layer": layer,
        "tile": tile.morton,
        "version": version,
        "parent": head.version,
        "kind": origin.kind,
        "created_ns": _after_newest(c, layer, tile, now),
        "merger": origin.merger,
        "n_reports": len(origin.provenance.report_ids),
        "sha": content.sha,
        "codec_id": content.codec_id,
        "size_bytes": len(content.body),
        "provenance": encode_provenance(origin.provenance),
        "body": content.body,
        "epoch": head.epoch if origin.kind == "merged" else version,
    }
    change(c, "insert_version", row)
    if change(c, "swap_head" if head.version else "insert_head", row) != 1:
        raise StoreError(f"tile {tile.path} of layer {layer}: head {head.version} has moved inside a transaction")
    if origin.kind != "merged":  # a new epoch: what waited is forgotten with the reports that claimed it
        trials.supersede(c, layer, tile, now)
        confirmation.keep(c, layer, tile, ())
        journal.begin_epoch(c, layer, tile, version)
    if head.version or origin.kind == "merged":  # what an import adds to the map is found through the catalog
        change(c, "insert_notice", row)
    return version


def _after_newest(c: apsw.Connection, layer: str, tile: TileId, now: int) -> int:
    # Times of versions only grow, also when the clocks of two processes disagree: reading at a time depends on it.
    newest = fetch(c, "newest_created", {"layer": layer, "tile": tile.morton})
    return max(now, newest[0][0] + 1) if newest else now


def _check_reports(c: apsw.Connection, publication: Publication) -> None:
    unknown = inbox.unknown_reports(c, publication.claim, publication.report_ids)
    if unknown:  # what is remembered of earlier windows may rest on reports that retention has removed
        raise UnknownReports(
            f"tile {publication.claim.tile.path} of layer {publication.claim.layer}: {len(unknown)} of"
            f" {len(publication.report_ids)} report ids are not in the store, first {unknown[0]}; nothing was published"
        )
