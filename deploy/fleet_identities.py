"""The identities of a fleet run: an authority and a certificate for each process, made on the fly."""

from pathlib import Path

from gnd.fleet_bus.identity.names import MemberName


def make_identities(folder: Path, shards: int, vehicles: int) -> Path:
    """Makes an authority and the identity folders of all processes of a run, each under its process's name.

    Args:
        folder: of the run; they go into its folder `identities`, the authority into `authority`.
        shards: number of merger shards.
        vehicles: number of vehicles.

    Returns:
        The folder of the identities: router, store, merger-0 ..., watcher, fleet, vehicle-00 ...
    """
    from gnd.fleet_bus.identity.authority import Authority

    authority, out = Authority.create(folder / "authority", "GND fleet run"), folder / "identities"
    members = {
        "router": MemberName("router", "router"),
        "store": MemberName("tiles", "store"),
        **{f"merger-{n}": MemberName("shard", f"shard-{n}") for n in range(shards)},
        "watcher": MemberName("operator", "watcher"),
        "fleet": MemberName("operator", "fleet"),
        **{f"vehicle-{n:02d}": MemberName("vehicle", f"vehicle-{n:02d}") for n in range(vehicles)},
    }
    for process, member in members.items():
        authority.issue(member, out / process)
    authority.copy_lists(out / process for process in members)
    return out
