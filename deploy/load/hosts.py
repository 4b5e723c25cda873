"""`gnd load --hosts`: the same load on a laboratory of hosts, in network namespaces, with a region for each client."""

from dataclasses import dataclass, replace
from pathlib import Path

from gnd.cloud_merger.config import ShardConfig
from gnd.deploy.errors import LabError
from gnd.deploy.interruption import EndEvent
from gnd.deploy.lab.groups import Group
from gnd.deploy.lab.hosts.cloud import BUS_LEASE_MS, LEASE_S
from gnd.deploy.lab.hosts.identities import make_lab_identities
from gnd.deploy.lab.hosts.plan import HostsPlan
from gnd.deploy.lab.hosts.postgres import server_programs, server_user
from gnd.deploy.lab.hosts.running import HostsCloud, opened_hosts, running_hosts
from gnd.deploy.lab.lab import Lab
from gnd.deploy.lab.namespaces import inside
from gnd.deploy.load.drives import KeptRuns
from gnd.deploy.load.plan import LoadOptions, shared_out
from gnd.deploy.load.run import LoadCloud, Tell, measured, put_streets, shard_of_load, vehicles_of
from gnd.deploy.load.streets import Streets
from gnd.deploy.load.verdict import LoadOutcome
from gnd.deploy.processes import start_fork_server
from gnd.fleet_bus.links import UNLIMITED
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.sqlite_store import SqlStore


@dataclass(frozen=True, slots=True)
class LoadOnHosts:
    """A load with the laboratory that it is sent to.

    Attributes:
        plan: which part is on which host.
        options: of the load; one shard a region, whatever `shards` says.
        runs: the kept drives.
        folder: empty; for logs, identities and accounts.
    """

    plan: HostsPlan
    options: LoadOptions
    runs: KeptRuns
    folder: Path

    def run(self, tell: Tell, stop: EndEvent) -> LoadOutcome:
        """Replay kept drives as many vehicles, through the routers of all regions; see `run_load`. `stop` is awaited
        from when the laboratory works.

        Raises:
            LabError: the laboratory cannot be made, or does not stay alive.
            LoadError: the drives cannot be replayed.
            DeployError: the clients do not start.
        """
        server_programs()
        server_user()
        streets = Streets.of(self.runs, self.options)
        start_fork_server()
        with opened_hosts(self.plan, self._groups(), self.folder) as (lab, folders):
            if self.plan.size.is_secure:
                make_lab_identities(self.plan, self.folder, vehicles_of(self.options))

            def put_map(store: SqlStore) -> TileId:
                put_streets(streets, store, tell, stop)
                return streets.tiles(0)[0].tile_id

            with (
                inside(lab.cloud_namespace),
                running_hosts(self.plan, lab, folders, put_map, _lab_shard) as cloud,
            ):
                stop.is_awaited = True
                options = replace(self.options, shards=self.plan.size.regions)
                return measured(self._cloud(cloud, lab), options, self.runs, self.folder, tell, stop)

    def _groups(self) -> tuple[Group, ...]:
        """A namespace for each client; it is many vehicles, so its link is as fast as the machine."""
        count = len(shared_out(self.options.vehicles, self.options.clients))
        return tuple(Group(f"client-{n}", UNLIMITED, n, 1) for n in range(count))

    def _cloud(self, cloud: HostsCloud, lab: Lab) -> LoadCloud:
        plan = self.plan
        regions = plan.size.regions
        places = tuple(
            (plan.routers(number % regions), link.vehicle_namespace) for number, link in enumerate(lab.links)
        )

        def poll() -> None:
            if cloud.died:
                raise LabError(f"{'; '.join(cloud.died)}: read {cloud.folders.logs}")

        return LoadCloud(
            plan.database_url,
            cloud.supervisor,
            cloud.start,
            cloud.stop,
            poll,
            tuple(part for host in plan.hosts for part in host.parts),
            regions,
            places,
            cloud.folders.identities if plan.size.is_secure else None,
            {host.name: host.parts for host in plan.hosts},
        )


def _lab_shard(name: str, url: str, routers: tuple[str, ...]) -> ShardConfig:
    return replace(shard_of_load(name, url, routers), bus_lease_ms=BUS_LEASE_MS, lease_s=LEASE_S)
