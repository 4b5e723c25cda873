"""Tile versions in SQL: each function runs inside the caller's transaction."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadValue
from gnd.schemas.version_signature import VersionSignature
from gnd.tile_store import sql_accounts as accounts
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_confirmation as confirmation
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store import sql_journal as journal
from gnd.tile_store import sql_refuted as refuted
from gnd.tile_store import sql_standing as standing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store import sql_trust as trust
from gnd.tile_store.bodies import lies_elsewhere
from gnd.tile_store.connection import Row, SqlConnection, change, fetch, post
from gnd.tile_store.errors import StoreDamaged, StoreError, UnknownReports, UnknownVersion
from gnd.tile_store.provenance import NOTHING, Provenance, encode_provenance
from gnd.tile_store.signing import Signing, check_signed, columns, sign_again
from gnd.tile_store.values import (
    NS_PER_S,
    ClosedWindow,
    Content,
    GcResult,
    Publication,
    PublishResult,
    StoredTile,
    VersionKind,
    day_of_version,
)


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
    surveyed_ns: int | None = None


def publish(
    c: SqlConnection,
    publication: Publication,
    content: Content | None,
    timing: dict[str, Any],
    signing: Signing | None,
) -> PublishResult:
    """One publication: fence, compare-and-swap of the head, consumption of the reports."""
    claim = publication.claim
    head = _head(c, claim.layer, claim.tile)
    if not inbox.holds(c, claim):
        return PublishResult("stale", head.version)
    is_old = head.version != publication.base_version or trust.is_outdated(c, claim.layer, publication.basis)
    if is_old or trials.open_trial(c, claim.layer, claim.tile) is not None:
        # Ready at once, against what is so now. The merge came to its end: it is no attempt that the tile has spoilt.
        inbox.postpone(c, claim, timing["steady"], blameless=True)
        return PublishResult("stale", head.version)
    _check_reports(c, publication)
    result = PublishResult("unchanged", head.version)
    if content is not None and content.sha != head.sha:
        result = _appended(c, publication, content, head, timing["now"], signing)
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


def _appended(
    c: SqlConnection, publication: Publication, content: Content, head: _Head, now: int, signing: Signing | None
) -> PublishResult:
    """The next version of a tile, on trial where that is wanted."""
    claim = publication.claim
    origin = _Origin(publication.reason, claim.owner, Provenance.of(publication.report_ids, publication.voxel_reports))
    with catalogs.changing(c, signing, claim.layer, claim.tile, catalogs.kind_of(origin.kind)):
        version = _append(c, claim.layer, claim.tile, content, origin, now, signing)
        if publication.trial is not None and head.version and not is_feature_layer(claim.layer):
            trials.begin(c, claim.layer, claim.tile, (head.version, version), publication.trial, now)
    return PublishResult("published", version)


def _put_tests(c: SqlConnection, publication: Publication, timing: dict[str, Any], is_news: bool) -> None:
    """The accounts of the vehicles, and which of their reports about features are refuted now."""
    claim, tests = publication.claim, publication.shift_tests
    vehicles = {test.vehicle for test in tests} if is_feature_layer(claim.layer) else set()
    before = refuted.refuted(c, claim.layer, vehicles)
    accounts.put_tests(c, claim.layer, claim.tile, tests, timing)
    trust.put_tests(c, claim.layer, claim.tile, publication.agreement_tests, timing, is_news)
    if publication.basis is not None and not is_feature_layer(claim.layer):
        windows = (*publication.closed, publication.basis.window)
        standing.put_standings(c, claim.layer, claim.tile, windows, publication.standings, timing)
        alone = {one.vehicle for one in publication.standings if one.alone}
        alone |= {one.vehicle for one in publication.waiting or ()}
        standing.merge_by_words_of_now(c, claim.layer, claim.tile, publication.basis.named, alone, timing)
    judged = [test.vehicle for test in publication.agreement_tests]
    standing.put_coincidences(c, claim.layer, claim.tile, publication.coincidences, judged, timing)
    refuted.merge_again(c, claim.layer, before, refuted.refuted(c, claim.layer, vehicles), timing)


def put_base(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    content: Content,
    kind: VersionKind,
    now: int,
    surveyed_ns: int | None = None,
    *,
    signing: Signing | None,
) -> PublishResult:
    """Import a tile: a new epoch, unless the head is an epoch of the same content."""
    head = _head(c, layer, tile)
    is_known = bool(head.version) and head.version == head.epoch and head.sha == content.sha
    version = head.version
    if not is_known:
        with catalogs.changing(c, signing, layer, tile, catalogs.kind_of(kind)):
            version = _append(c, layer, tile, content, _Origin(kind, surveyed_ns=surveyed_ns), now, signing)
    if surveyed_ns is not None:
        row = {"layer": layer, "tile": tile.morton, "version": version, "surveyed_ns": surveyed_ns}
        change(c, "put_survey", row)
    if is_known:
        _sign_known(c, layer, tile, content.sha, signing)
    return PublishResult("unchanged" if is_known else "published", version)


def _sign_known(c: SqlConnection, layer: str, tile: TileId, sha: bytes, signing: Signing | None) -> None:
    """Sign content that was imported again: the day of its survey may be another one now, or nobody has signed it."""
    (known,) = stored_heads(c, layer, [tile])
    if known is None or known.sha != sha:
        raise StoreDamaged(f"tile {tile.path} of layer {layer}: its newest version is not what the head says")
    if signing is not None or known.signature is not None:
        sign_again(c, signing, known)


def rollback(c: SqlConnection, layer: str, tile: TileId, version: int, now: int, signing: Signing | None) -> StoredTile:
    """Publish the next version with the body of an older one."""
    with catalogs.changing(c, signing, layer, tile, "rollback"):
        return roll_back_released(c, layer, tile, version, now, signing)


def roll_back_released(
    c: SqlConnection, layer: str, tile: TileId, version: int, now: int, signing: Signing | None
) -> StoredTile:
    """As `rollback`, for who has begun to change the catalog already."""
    old = stored(c, "stored_version", layer, tile, version=version)
    if old is None:
        newest = _head(c, layer, tile).version
        raise UnknownVersion(f"tile {tile.path} of layer {layer} has no version {version} (newest: {newest})")
    check_signed(c, signing, old)  # or a body that somebody has put there would get our signature
    content = Content(old.sha, old.codec_id, old.body, check=old.body_check)
    size = fetch(c, "size_of_version", {"layer": layer, "tile": tile.morton, "version": version})[0][0]
    _append(c, layer, tile, content, _Origin("rollback"), now, signing, size)
    (current,) = stored_heads(c, layer, [tile])
    assert current is not None
    return current


def stored(c: SqlConnection, statement: str, layer: str, tile: TileId, **values: int | bytes) -> StoredTile | None:
    """The version that one of the `stored_…` statements finds."""
    rows = fetch(c, statement, {"layer": layer, "tile": tile.morton, **values})
    return _version_of(rows[0]) if rows else None


def stored_heads(c: SqlConnection, layer: str, tiles: Sequence[TileId]) -> list[StoredTile | None]:
    """The newest versions of some tiles, in their order; None: there is none."""
    rows = fetch(c, "stored_heads", {"layer": layer, "tiles": json.dumps([tile.morton for tile in tiles])})
    found = {version.tile: version for version in map(_version_of, rows)}
    return [found.get(tile) for tile in tiles]


def _version_of(row: Row) -> StoredTile:
    name, morton, *told, signer, signed_s, signature = row
    found = StoredTile(name, TileId(morton), *told)
    if signer is None:
        return found
    try:
        made_s = found.created_ns // NS_PER_S
        return replace(found, signature=VersionSignature(signer, found.kind, made_s, signed_s, signature))
    except BadValue:  # none that anybody can have made: the version is as good as unsigned
        return found


def sha_of(c: SqlConnection, layer: str, tile: TileId, version: int) -> bytes:
    """The hash of a version; empty: there is none."""
    rows = fetch(c, "sha_of_version", {"layer": layer, "tile": tile.morton, "version": version})
    return rows[0][0] if rows else b""


def epoch_of(c: SqlConnection, layer: str, tile: TileId) -> int:
    """The latest version of a tile that is a base or a rollback; 0 when there is none."""
    return _head(c, layer, tile).epoch


def collect(c: SqlConnection, keep_versions: int) -> GcResult:
    """Remove versions older than the newest `keep_versions` of each tile, but for epochs and what reports cite."""
    sizes: list[int] = []
    for layer, morton in fetch(c, "tiles_with_history", {"keep": keep_versions}):
        head = _head(c, layer, TileId(morton))
        wanted = {"layer": layer, "tile": morton, "epoch": head.epoch, "oldest": head.version - keep_versions + 1}
        folded = journal.folded(c, layer, TileId(morton), head.epoch)
        sizes += [size for (size,) in fetch(c, "delete_old_versions", wanted | {"folded": folded})]
    return GcResult(len(sizes), sum(sizes))


def _head(c: SqlConnection, layer: str, tile: TileId) -> _Head:
    rows = fetch(c, "head", {"layer": layer, "tile": tile.morton})
    return _Head(*rows[0]) if rows else _Head(0, 0, b"")


def _append(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    content: Content,
    origin: _Origin,
    now: int,
    signing: Signing | None,
    size_bytes: int | None = None,
) -> int:
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
        "size_bytes": len(content.body) if size_bytes is None else size_bytes,
        "provenance": encode_provenance(origin.provenance),
        "body": b"" if lies_elsewhere(c, content) else content.body,
        "body_check": content.check,
        "epoch": head.epoch if origin.kind == "merged" else version,
    }
    row |= columns(c, signing, row, day_of_version(origin.kind, row["created_ns"], origin.surveyed_ns))
    post(c, "insert_version", row)
    if change(c, "swap_head" if head.version else "insert_head", row) != 1:
        raise StoreError(f"tile {tile.path} of layer {layer}: head {head.version} has moved inside a transaction")
    if origin.kind != "merged":  # a new epoch: what waited is forgotten with the reports that claimed it
        trials.supersede(c, layer, tile, now)
        confirmation.keep(c, layer, tile, ())
        journal.begin_epoch(c, layer, tile, version)
    if head.version or origin.kind == "merged":  # what an import adds to the map is found through the catalog
        post(c, "insert_notice", row)
    return version


def _after_newest(c: SqlConnection, layer: str, tile: TileId, now: int) -> int:
    # Times of versions only grow, also when the clocks of two processes disagree: reading at a time depends on it.
    newest = fetch(c, "newest_created", {"layer": layer, "tile": tile.morton})
    return max(now, newest[0][0] + 1) if newest else now


def _check_reports(c: SqlConnection, publication: Publication) -> None:
    unknown = inbox.unknown_reports(c, publication.claim, publication.report_ids)
    if unknown:  # what is remembered of earlier windows may rest on reports that retention has removed
        raise UnknownReports(
            f"tile {publication.claim.tile.path} of layer {publication.claim.layer}: {len(unknown)} of"
            f" {len(publication.report_ids)} report ids are not in the store, first {unknown[0]}; nothing was published"
        )
