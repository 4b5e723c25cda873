"""The identities of a run: an authority and a certificate for each process, made on the fly; and who signs its map."""

import datetime as dt
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.identity.names import MemberName

if TYPE_CHECKING:
    from gnd.tile_store.sqlite_store import SqlStore

FLEET: Final = "fleet"
"""The operator who starts a run: its identity signs the map that is there before anybody reports."""


def make_identities(folder: Path, shards: int, vehicles: int) -> Path:
    """Makes an authority and the identity folders of all processes of a fleet, each under its process's name.

    Args:
        folder: of the run; they go into its folder `identities`, the authority into `authority`.
        shards: number of merger shards.
        vehicles: number of vehicles.

    Returns:
        The folder of the identities: router, store, merger-0 ..., watcher, fleet, vehicle-00 ...
    """
    members = of_cloud(shards) | {
        "watcher": MemberName("operator", "watcher"),
        **{f"vehicle-{n:02d}": MemberName("vehicle", f"vehicle-{n:02d}") for n in range(vehicles)},
    }
    return issue_identities(folder, members)


def of_cloud(shards: int) -> dict[str, MemberName]:
    """Who the processes of `roles.of_cloud` are, and who starts them."""
    return {
        "router": MemberName("router", "router"),
        "store": MemberName("tiles", "store"),
        **{f"merger-{n}": MemberName("shard", f"shard-{n}") for n in range(shards)},
        FLEET: MemberName("operator", FLEET),
    }


def issue_identities(
    folder: Path,
    members: Mapping[str, MemberName],
    hosts: Mapping[str, Sequence[str]] | None = None,
    begins: dt.datetime | None = None,
) -> Path:
    """Makes an authority, and an identity folder for each process.

    Args:
        folder: of the run.
        members: by name of the process.
        hosts: of routers, under which addresses they are reached beside those of this machine.
        begins: of all certificates; None: five minutes ago.

    Returns:
        The folder of the identities.
    """
    from gnd.fleet_bus.identity.authority import Authority

    authority, out = Authority.create(folder / "authority", "GND fleet run"), folder / "identities"
    for process, member in members.items():
        authority.issue(member, out / process, hosts=(hosts or {}).get(process, ()), begins=begins)
    authority.copy_lists(out / process for process in members)
    return out


def sign_map(store: "SqlStore") -> None:
    """Sign all that a store holds, as its identity: without that no vehicle would take it."""
    from gnd.tile_store.catalogs import sign_unsigned_catalogs
    from gnd.tile_store.district_lists import sign_list
    from gnd.tile_store.signatures import sign_unsigned

    sign_unsigned(store)
    sign_unsigned_catalogs(store)
    for layer in store.layers():
        sign_list(store, layer)
