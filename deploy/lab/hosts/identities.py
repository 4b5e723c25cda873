"""The certificates of a laboratory: an authority of its own, and an identity for each part, vehicle and asker."""

import datetime as dt
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from gnd.deploy.chaos.clients import first_pseudonym
from gnd.deploy.chaos.inflict import MESSENGER
from gnd.deploy.fleet_identities import FLEET, issue_identities
from gnd.deploy.lab.hosts.plan import HUB, HostsPlan, client_names
from gnd.fleet_bus.identity.names import MemberName

BEGAN: Final = dt.timedelta(days=1)
"""So long ago all certificates began, as in a fleet that has been running: a clock that is late by minutes then meets
the bound of the seals, not the first moment of a certificate."""


def members_of(plan: HostsPlan) -> dict[str, MemberName]:
    """Who has an identity, by name of the process. A vehicle reports under its first pseudonym alone: its certificate
    names it, and who seals a report must be who it is of.
    """
    members = {HUB: MemberName("router", HUB)}
    for region in range(plan.size.regions):
        members |= {f"{part}-{region}": MemberName(part, f"{part}-{region}") for part in ("router", "tiles", "shard")}
        *vehicles, asker = client_names(plan, region)
        members |= {name: MemberName("vehicle", first_pseudonym(name)) for name in vehicles}
        members[asker] = MemberName("vehicle", asker)
    return members | {MESSENGER: MemberName("vehicle", MESSENGER), FLEET: MemberName("operator", FLEET)}


def make_lab_identities(plan: HostsPlan, folder: Path, others: Mapping[str, MemberName] | None = None) -> None:
    """Make them all, in the folder of the run, and those of `others`; routers are reached at the addresses of their
    hosts.
    """
    routers = [HUB, *(f"router-{region}" for region in range(plan.size.regions))]
    hosts = {name: (plan.host_of(name).address,) for name in routers}
    issue_identities(folder, members_of(plan) | dict(others or {}), hosts, dt.datetime.now(dt.UTC) - BEGAN)
