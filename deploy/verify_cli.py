"""`gnd map verify`: is every version what its journal gives?"""

from collections import Counter
from dataclasses import asdict
from typing import Any, Final

import click
from rich.console import Console
from rich.progress import track

from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.publishers import Publishers
from gnd.tile_store import tables
from gnd.tile_store.cli import json_option, layer_option, region_option, show
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import to_read
from gnd.tile_store.values import DEFAULT_CODEC, MAP_CODECS

_OLD: Final = "Of the shards, where the store does not say: it was merged by an older release."


@click.command(short_help="Recompute versions from the reports, and compare.")
@click.argument("path", metavar="STORE", type=LOCATION)
@layer_option
@region_option
@click.option("--all-versions", is_flag=True, help="Every stored version, not only the newest of each tile.")
@click.option("--codec", default=DEFAULT_CODEC, show_default=True, type=click.Choice(MAP_CODECS), help=_OLD)
@click.option("--merge-mode", default="default", show_default=True, type=click.Choice(("default", "paper")), help=_OLD)
@click.option("--signatures", is_flag=True, help="Instead: who answers for them, by the authority of --identity.")
@json_option
@identity_option
def verify(
    path: StoreLocation,
    layer: str,
    region: str,
    all_versions: bool,
    codec: str,
    merge_mode: Any,
    signatures: bool,
    as_json: bool,
) -> None:
    """Recompute the tiles of store PATH from their journals and compare them bit for bit.

    Each window is merged with the parameters that its shard had, which the store keeps.

    Ends with 1 where one differs. Versions whose reports retention has removed cannot be computed and are counted.

    With --signatures it says by whom each version and the catalog of each district is signed, and ends with 1 where
    nobody answers for one.
    """
    if signatures:
        _signatures(path, layer, region, all_versions, as_json)
        return
    # loaded here: it loads scipy and numba, which the other commands do without
    from gnd.cloud_merger.config import ShardConfig
    from gnd.cloud_merger.parameters import MergeParameters
    from gnd.cloud_merger.verify import Verified, Verifier

    with to_read(path) as store:
        config = ShardConfig(store_path=path, codec=codec, merge=MergeParameters(mode=merge_mode))
        verifier = Verifier(store, config)
        heads, found = store.heads(layer, region), list[Verified]()
        for head in track(heads, "tiles", console=Console(stderr=True), transient=True):
            known = verifier.history(layer, head.tile) if all_versions else ()
            found += list(known) or [verifier.version(layer, head.tile, head.version)]
    counts = Counter(one.status for one in found)
    wrong = [asdict(one) | {"tile": one.tile.path} for one in found if one.status in ("differs", "unknown")]
    values: dict[str, Any] = {name: counts[name] for name in ("same", "given", "unknown", "differs")}
    assumed = [one for one in found if one.assumed]
    old = f"codec {codec}, merge mode {merge_mode}, else defaults: {assumed[0].assumed[:16]}…" if assumed else ""
    values |= {"with parameters assumed": len(assumed), "assumed": old} if assumed else {}
    show(
        values | {"identical": not counts["differs"], "versions": wrong},
        as_json,
        lambda console: _print(console, f"{shown(path)}, layer {layer}", values, wrong),
    )
    if counts["differs"]:
        raise SystemExit(1)


def _signatures(path: StoreLocation, layer: str, region: str, all_versions: bool, as_json: bool) -> None:
    """Say who answers for the versions of a region."""
    from gnd.tile_store.catalogs import answered_catalogs
    from gnd.tile_store.district_lists import answered_list
    from gnd.tile_store.signatures import GOOD
    from gnd.tile_store.signatures import signatures as answered

    with to_read(path) as store:
        publishers = authority_of_environment()
        found = list(answered(store, publishers, layer, region, all_versions=all_versions))
        catalogs = list(answered_catalogs(store, publishers, layer, region))
        listed = answered_list(store, publishers, layer)
    by = Counter(one.who if one.status == GOOD else one.status for one in found)
    wrong = [asdict(one) | {"tile": one.tile.path} for one in found if one.status != GOOD]
    signed = {who: n for who, n in sorted(by.items()) if any(one.who == who for one in found)}
    others = {status: n for status, n in sorted(by.items()) if status not in signed}
    values: dict[str, Any] = {"versions": len(found), "signed_by": signed, "not_answered_for": others, "wrong": wrong}
    told: dict[str, int | str] = {"versions": len(found)}
    told |= {f"signed by {who}": n for who, n in signed.items()} | others
    by_status = Counter(one.status for one in catalogs)
    wrong_catalogs = [asdict(one) | {"district": one.district.path} for one in catalogs if one.status != GOOD]
    values |= {"catalogs": dict(by_status), "wrong_catalogs": wrong_catalogs}
    told |= {f"catalogs, {status}": n for status, n in sorted(by_status.items())}
    values |= {"list": asdict(listed)}
    told |= {"list of districts": listed.status}

    def print_it(console: Console) -> None:
        _print(console, f"{shown(path)}, layer {layer}", told, wrong)
        for one in wrong_catalogs[:20]:
            line = f"catalog of district {one['district']} {one['status']}: {one['why']}"
            console.print(line, highlight=False, soft_wrap=True)
        if listed.status != GOOD:
            console.print(f"list of districts {listed.status}: {listed.why}", highlight=False, soft_wrap=True)

    show(values, as_json, print_it)
    if wrong or wrong_catalogs or listed.status != GOOD:
        raise SystemExit(1)


def authority_of_environment() -> Publishers:
    """Whose signatures count, by the identity of this process.

    Raises:
        StoreError: it has none.
    """
    folder = identity_of_environment()
    if folder is None:
        raise StoreError("signatures are judged by an authority: --identity FOLDER, of anybody in the fleet")
    return Publishers(folder)


def _print(console: Console, title: str, values: dict[str, Any], wrong: list[dict[str, Any]]) -> None:
    console.print(tables.fields(title, values))
    for one in wrong[:20]:
        console.print(
            f"{one['tile']} version {one['version']} {one['status']}: {one.get('reason') or one['why']}",
            highlight=False,
            soft_wrap=True,
        )
