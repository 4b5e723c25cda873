"""A fleet in a lab: which process runs where, and the account of its links."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gnd.deploy.lab.groups import ROUTER_FROM_CLOUD, ROUTER_LISTENS, unpaced
from gnd.deploy.lab.lab import Lab
from gnd.deploy.lab.namespaces import inside
from gnd.deploy.lab.relay import read_account, run_relay
from gnd.deploy.lab.report import Evidence, account, as_json, count_links, write_account
from gnd.deploy.lab.sampler import sampling
from gnd.deploy.processes import ProcessSpec
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.site import SiteFrame, VehicleSite
from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger_file import AgentLedger, read_ledger

RELAYS: Final = "relays"
ACCOUNT: Final = "lab.json"


def lab_site(lab: Lab, relays: Path) -> SiteFrame:
    """Return where the processes of a fleet run: the cloud in one namespace, each group in another."""
    vehicles = tuple(VehicleSite(link.endpoint, unpaced(link.profile), link.vehicle_namespace) for link in lab.links)
    return SiteFrame(ROUTER_LISTENS, ROUTER_FROM_CLOUD, vehicles, lab.cloud_namespace, relay_processes(lab, relays))


def relay_processes(lab: Lab, relays: Path) -> tuple[ProcessSpec, ...]:
    """Return one relay process for each group whose links need one.

    Args:
        lab: the lab.
        relays: folder of the relays' accounts, made here.
    """
    relays.mkdir(parents=True, exist_ok=True)
    carried = {group.name: tuple(link for link in lab.links_of(group) if link in lab.relayed) for group in lab.groups}
    return tuple(ProcessSpec(f"link-{name}", run_relay, (links, relays)) for name, links in carried.items() if links)


@dataclass
class LabRun:
    """One fleet run in a lab.

    Attributes:
        lab: where.
        folder: the run.
        report: the account of the links once the fleet has run, also in `lab.json`; empty before.
    """

    lab: Lab
    folder: RunFolder
    report: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def place(self) -> Iterator[SiteFrame]:
        """Give the site of the fleet: the launcher is in the cloud's namespace, and the links are watched.

        The links are accounted for when the block has ended well.
        """
        relays = self.folder.root / RELAYS
        with sampling(self.lab) as seen, inside(self.lab.cloud_namespace):
            yield lab_site(self.lab, relays)
        evidence = Evidence(
            count_links(self.lab), seen, read_account(relays), read_ledgers(self.folder, len(self.lab.links))
        )
        self.report = as_json(self.lab.name, account(self.lab, evidence))
        write_account(self.folder.root / ACCOUNT, self.report)


def read_ledgers(folder: RunFolder, vehicles: int) -> dict[int, AgentLedger]:
    """Return the ledgers of a run by number of the vehicle; one that left none is missing."""
    found: dict[int, AgentLedger] = {}
    for number in range(vehicles):
        try:
            found[number] = read_ledger(folder.ledger / f"vehicle-{number:02d}.jsonl")
        except LedgerError:
            continue
    return found
