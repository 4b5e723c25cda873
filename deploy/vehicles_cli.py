"""`gnd vehicles`: whose reports count, why not, and what an operator decides about it."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.tile_store.errors import StoreError
from gnd.tile_store.options import PATH, existing, json_option, show, to_read
from gnd.tile_store.status import naming_line
from gnd.tile_store.store import Store
from gnd.tile_store.values import VehicleTrust


@click.group()
def vehicles() -> None:
    """Whose reports count, why not, and what an operator decides about it."""


@vehicles.command("list", short_help="The vehicles that others could judge.")
@click.argument("path", metavar="STORE", type=PATH)
@json_option
def list_command(path: Path, as_json: bool) -> None:
    """The vehicles of STORE that others could judge: where they were contradicted, and who does not count."""
    with to_read(path) as store:
        found = store.vehicle_trusts()
    values = {"vehicles": [asdict(one) for one in found]}
    show(values, as_json, lambda console: _print_list(console, str(path), found))


@vehicles.command("why", short_help="All that is known about one vehicle.")
@click.argument("path", metavar="STORE", type=PATH)
@click.argument("vehicle")
@json_option
def why_command(path: Path, vehicle: str, as_json: bool) -> None:
    """What STORE knows about VEHICLE: how its reports agree with those of others, shifts, mount, what waits."""
    with to_read(path) as store:
        values = account_of(store, vehicle)
    show(values, as_json, lambda console: _print_why(console, values))


@vehicles.command("quarantine", short_help="Let the reports of a vehicle count no more.")
@click.argument("path", metavar="STORE", type=PATH)
@click.argument("vehicle")
@click.option("--why", required=True, help="The reason, in a line; it is kept and shown.")
def quarantine_command(path: Path, vehicle: str, why: str) -> None:
    """Let the reports of VEHICLE count no more, until `gnd vehicles release`.

    Tiles whose open window holds its reports are merged again without them by the running shards. What was folded
    before is taken back by `gnd map rollback STORE vehicle:VEHICLE`.
    """
    with existing(path) as store:
        store.quarantine_vehicle(vehicle, why)
    click.echo(f"{vehicle} is quarantined: {why}")


@vehicles.command("release", short_help="Let the reports of a vehicle count again.")
@click.argument("path", metavar="STORE", type=PATH)
@click.argument("vehicle")
def release_command(path: Path, vehicle: str) -> None:
    """Let the reports of VEHICLE count again, and pardon what was held against it until now."""
    with existing(path) as store:
        if not store.release_vehicle(vehicle):
            raise StoreError(f"{vehicle} is not quarantined in {path}")
    click.echo(f"{vehicle} counts again")


def account_of(store: Store, vehicle: str) -> dict[str, Any]:
    """What a store knows about a vehicle.

    Raises:
        StoreError: it knows nothing.
    """
    trust = next((one for one in store.vehicle_trusts() if one.vehicle == vehicle), None)
    account = next((one for one in store.vehicle_accounts() if one.vehicle == vehicle), None)
    waiting = [asdict(one) | {"tile": one.tile.path} for one in store.waiting_changes() if one.vehicle == vehicle]
    if trust is None and account is None and not waiting:
        raise StoreError(f"nothing is known about {vehicle}: others could not judge it yet, or it has sent nothing")
    return {
        "vehicle": vehicle,
        "trust": None if trust is None else asdict(trust),
        "poses": None if account is None else asdict(account) | {"says": naming_line(account)},
        "waiting": waiting,
    }


def _print_list(console: Console, path: str, found: list[VehicleTrust]) -> None:
    table = Table("vehicle", "tiles judged", "contradicted", "claims wrong", "missed", "counts", title=path)
    for one in found:
        table.add_row(
            one.vehicle,
            str(one.tested),
            str(one.refuted),
            f"{one.refuted_claims} of {one.claims}",
            f"{one.refuted_quotes} of {one.quotes}",
            "yes" if not one.is_quarantined else f"[red]no[/]: {one.why} ({one.by})",
        )
    console.print(table)


def _print_why(console: Console, values: dict[str, Any]) -> None:
    trust, poses = values["trust"], values["poses"]
    if trust is not None and trust["is_quarantined"]:
        since = datetime.fromtimestamp(trust["since_ns"] / 1e9, UTC)
        console.print(
            f"{values['vehicle']} does not count since {since:%Y-%m-%d %H:%M} UTC ({trust['by']}): {trust['why']}"
        )
    if trust is not None and trust["tested"]:
        console.print(
            f"contradicted in {trust['refuted']} of {trust['tested']} tiles: {trust['refuted_claims']} of"
            f" {trust['claims']} changes that it claimed, {trust['refuted_quotes']} of {trust['quotes']} voxels that it"
            " called unchanged"
        )
    if poses is not None:
        console.print(poses["says"])
    for one in values["waiting"]:
        console.print(f"waits in tile {one['tile']}: {one['voxels']} voxels ({one['reason']})", highlight=False)
