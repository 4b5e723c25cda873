"""`gnd map sign`: sign the versions of a store for which nobody answers, as far as they can be vouched for."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import click
from rich.console import Console

from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store import tables
from gnd.tile_store.catalogs import answered_catalogs, sign_whole_catalog
from gnd.tile_store.district_lists import answered_list, sign_list
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import json_option, region_option, show, to_publish
from gnd.tile_store.signatures import GOOD, NEVER_SIGNED, AnsweredVersion, sign_versions, signatures
from gnd.tile_store.sqlite_store import SqlStore


@click.command(short_help="Sign versions for which nobody answers.")
@click.argument("path", metavar="STORE", type=LOCATION)
@region_option
@click.option("--unchecked", is_flag=True, help="Also what cannot be computed anew: you have looked at it yourself.")
@click.option("--dry-run", is_flag=True, help="Only say what would be signed.")
@json_option
@identity_option
def sign(path: StoreLocation, region: str, unchecked: bool, dry_run: bool, as_json: bool) -> None:
    """Sign, with the identity of an operator (--identity), the versions of STORE for which nobody answers.

    A map from before signatures: all of it. After `gnd certs revoke` of a shard: what it had signed. Merged versions
    are computed anew from their reports first, and signed where that gives the same, bit for bit. Bases and rollbacks
    of a revoked or foreign signer, and merges whose reports are gone, are signed with --unchecked alone. What was
    changed after it was signed is never signed; roll it back, or import it again. Then the catalogs of districts for
    which nobody answers, or that name other versions than are there (--unchecked), and the lists of districts. Ends
    with 1 where something is left.
    """
    with to_publish(path) as store:
        if store.signing is None:
            raise NotPublished(f"{shown(path)}: nobody to sign with: --identity FOLDER of an operator")
        publishers = store.signing.publishers
        found = [
            one for layer in store.layers() for one in signatures(store, publishers, layer, region, all_versions=True)
        ]
        open_ones = [one for one in found if one.status != GOOD]
        left = dict(_left(store, path, open_ones, unchecked=unchecked))
        to_sign = [one for one in open_ones if one not in left]
        signed = len(to_sign) if dry_run else sign_versions(store, to_sign)
        catalogs, unsigned = _catalogs(store, region, unchecked=unchecked, dry_run=dry_run)
    values: dict[str, Any] = {"versions": len(found), "signed": signed, "left": len(left), "dry_run": dry_run}
    values |= {"catalogs_signed": catalogs, "left_catalogs": unsigned}
    rows = [asdict(one) | {"tile": one.tile.path, "left_because": why} for one, why in left.items()]
    title = f"{shown(path)}: {'would be signed' if dry_run else 'signed'}"
    show(values | {"left_versions": rows}, as_json, lambda console: _print(console, title, values, rows))
    if left or unsigned:
        raise SystemExit(1)


def _catalogs(store: SqlStore, region: str, *, unchecked: bool, dry_run: bool) -> tuple[int, list[dict[str, str]]]:
    """Sign the catalogs and lists of districts for which nobody answers: how many, and of those that are left why."""
    assert store.signing is not None
    publishers, signed, left = store.signing.publishers, 0, list[dict[str, str]]()
    for layer in store.layers():
        open_ones = [one for one in answered_catalogs(store, publishers, layer, region) if one.status != GOOD]
        for one in open_ones:
            why = "" if dry_run else sign_whole_catalog(store, layer, one.district, unchecked=unchecked)
            signed += not why
            left += [{"layer": layer, "district": one.district.path, "left_because": why}] if why else []
    for layer in store.layers():
        if answered_list(store, publishers, layer).status == GOOD:
            continue
        why = "" if dry_run else sign_list(store, layer, unchecked=unchecked)
        signed += not why
        left += [{"layer": layer, "district": "(the list of districts)", "left_because": why}] if why else []
    return signed, left


def _left(
    store: SqlStore, path: StoreLocation, found: Iterable[AnsweredVersion], *, unchecked: bool
) -> Iterator[tuple[AnsweredVersion, str]]:
    """The versions that are not to be signed, each with the reason."""
    # loaded here: they load scipy and numba, which the other commands do without
    from gnd.cloud_merger.config import ShardConfig
    from gnd.cloud_merger.verify import Verifier

    verifier = Verifier(store, ShardConfig(store_path=path))
    for one in found:
        if one.status in NEVER_SIGNED:
            yield one, one.why
            continue
        computed = verifier.version(one.layer, one.tile, one.version)
        if computed.status == "differs":
            yield one, computed.reason
        elif computed.status == "unknown" and not unchecked:
            yield one, f"{computed.reason}; look at it, then --unchecked"
        elif computed.status == "given" and one.status != "unsigned" and not unchecked:
            yield one, f"a {one.kind} cannot be computed anew; look at it, then --unchecked"


def _print(console: Console, title: str, values: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    told = {"versions looked at": values["versions"], "signed": values["signed"], "left": values["left"]}
    told |= {"catalogs signed": values["catalogs_signed"], "catalogs left": len(values["left_catalogs"])}
    console.print(tables.fields(title, told | dict(Counter(f"left, {row['status']}" for row in rows))))
    for row in rows[:20]:
        line = f"{row['layer']} {row['tile']} version {row['version']} {row['status']}: {row['left_because']}"
        console.print(line, highlight=False, soft_wrap=True)
    for one in values["left_catalogs"][:20]:
        line = f"catalog of district {one['district']} of layer {one['layer']}: {one['left_because']}"
        console.print(line, highlight=False, soft_wrap=True)
