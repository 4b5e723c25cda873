"""`gnd vehicles`: whose reports count, why not, and what an operator decides about it."""

from dataclasses import asdict
from datetime import UTC, date, datetime, timedelta
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.answers import tell
from gnd.cloud_merger.groups import groups_of
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import existing, json_option, show, to_read
from gnd.tile_store.sql_standing import IN_GENERAL, OF_OWNER
from gnd.tile_store.status import naming_line
from gnd.tile_store.store import Store
from gnd.tile_store.values import VehicleTrust


@click.group()
def vehicles() -> None:
    """Whose reports count, why not, and what an operator decides about it."""


@vehicles.command("list", short_help="The vehicles that others could judge.")
@click.argument("path", metavar="STORE", type=LOCATION)
@json_option
def list_command(path: StoreLocation, as_json: bool) -> None:
    """The vehicles of STORE that others could judge: where they were contradicted, and who does not count."""
    with to_read(path) as store:
        found, groups = store.vehicle_trusts(), groups_of(store)
        alone, places = store.lone_words(), store.impossible_places()
    values = {
        "vehicles": [asdict(one) for one in found],
        "groups": [asdict(one) for one in groups],
        "not_believed_alone": [asdict(one) for one in alone],
        "impossible_places": [asdict(one) for one in places],
    }
    lines = [_said_together(asdict(one)) for one in groups]
    lines += [f"{one.vehicle} is {_not_believed(asdict(one))}" for one in alone if not one.vehicle.startswith(OF_OWNER)]
    lines += [_said_impossible(asdict(one)) for one in places]
    show(values, as_json, lambda console: _print_list(console, shown(path), found, lines))


@vehicles.command("why", short_help="All that is known about one vehicle.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("vehicle")
@json_option
def why_command(path: StoreLocation, vehicle: str, as_json: bool) -> None:
    """What STORE knows about VEHICLE: how its reports agree with those of others, shifts, mount, what waits."""
    with to_read(path) as store:
        values = account_of(store, vehicle)
    show(values, as_json, lambda console: _print_why(console, values))


@vehicles.command("quarantine", short_help="Let the reports of a vehicle count no more.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("vehicle")
@click.option("--why", required=True, help="The reason, in a line; it is kept and shown.")
@json_option
def quarantine_command(path: StoreLocation, vehicle: str, why: str, as_json: bool) -> None:
    """Let the reports of VEHICLE count no more, until `gnd vehicles release`.

    Tiles whose open window holds its reports are merged again without them by the running shards. What was folded
    before is taken back by `gnd map rollback STORE vehicle:VEHICLE`.
    """
    with existing(path) as store:
        store.quarantine_vehicle(vehicle, why)
    tell({"vehicle": vehicle, "is_quarantined": True, "why": why}, as_json, f"{vehicle} is quarantined: {why}")


@vehicles.command("release", short_help="Let the reports of a vehicle count again.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("vehicle")
@json_option
def release_command(path: StoreLocation, vehicle: str, as_json: bool) -> None:
    """Let the reports of VEHICLE count again, and pardon what was held against it until now."""
    with existing(path) as store:
        if not store.release_vehicle(vehicle):
            raise StoreError(f"{vehicle} is not quarantined in {shown(path)}")
    tell({"vehicle": vehicle, "is_quarantined": False}, as_json, f"{vehicle} counts again")


def account_of(store: Store, vehicle: str) -> dict[str, Any]:
    """What a store knows about a vehicle.

    Raises:
        StoreError: it knows nothing.
    """
    trust = next((one for one in store.vehicle_trusts() if one.vehicle == vehicle), None)
    account = next((one for one in store.vehicle_accounts() if one.vehicle == vehicle), None)
    waiting = [asdict(one) | {"tile": one.tile.path} for one in store.waiting_changes() if one.vehicle == vehicle]
    alone = [asdict(one) for one in store.lone_words() if one.vehicle == vehicle]
    places = next((one for one in store.impossible_places() if one.vehicle == vehicle), None)
    unheard = store.unheard_vehicles().get(vehicle, 0)
    if trust is None and account is None and not waiting and not alone and places is None and not unheard:
        raise StoreError(f"nothing is known about {vehicle}: others could not judge it yet, or it has sent nothing")
    together = next((one for one in groups_of(store) if vehicle in one.vehicles), None)
    return {
        "vehicle": vehicle,
        "group": None if together is None else asdict(together),
        "trust": None if trust is None else asdict(trust),
        "poses": None if account is None else asdict(account) | {"says": naming_line(account)},
        "not_believed_alone": alone,
        "impossible_places": None if places is None else asdict(places),
        "not_heard_in": unheard,
        "waiting": waiting,
    }


def _print_list(console: Console, path: str, found: list[VehicleTrust], lines: list[str]) -> None:
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
    for line in lines:
        console.print(line, highlight=False)


def _said_together(group: dict[str, Any]) -> str:
    names = ", ".join(group["vehicles"])
    said = f"{names} have sent the same measurements, to the bit, in {group['shared']} voxels"
    if group["by_chance"] > 0.0:
        said = f"{names} say the same false things: {group['shared']} voxels, {group['by_chance']:.0f} by chance"
    return said + "; they have one vote"


def _not_believed(word: dict[str, Any]) -> str:
    """For which day a vehicle is not believed alone, and why."""
    day = "" if word["day"] == IN_GENERAL else f" on {date(1970, 1, 1) + timedelta(days=word['day'])}"
    return f"not believed alone{day}: {word['why']}"


def _said_impossible(places: dict[str, Any]) -> str:
    at = datetime.fromtimestamp(places["at_ns"] / 1e9, UTC)
    return f"{places['times']} reports refused, the last on {at:%Y-%m-%d %H:%M} UTC: {places['why']}"


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
    if values["group"] is not None:
        console.print(_said_together(values["group"]))
    for one in values["not_believed_alone"]:
        console.print(_not_believed(one), highlight=False)
    if values["impossible_places"] is not None:
        console.print(_said_impossible(values["impossible_places"]), highlight=False)
    if values["not_heard_in"]:
        console.print(f"not heard about some kinds of change in {values['not_heard_in']} windows of tiles")
    if poses is not None and poses["says"]:
        console.print(poses["says"])
    for one in values["waiting"]:
        console.print(f"waits in tile {one['tile']}: {one['voxels']} voxels ({one['reason']})", highlight=False)
