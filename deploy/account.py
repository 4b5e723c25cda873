"""The account of a run: what agents sent, what the store holds, what the watcher saw."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnd.deploy.errors import PageError
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.traffic_page import write_page
from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger_file import read_run
from gnd.fleet_bus.links import load_link
from gnd.fleet_bus.traffic import DEFAULT_LINKS, AgentTraffic, agent_traffic, fleet_lines, fleet_totals
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import diff
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER, StoredTile
from gnd.vehicle_agent.link.outbox import Outbox

P95 = 0.95
_SIZES = ("drive_km", "down_bytes", "up_bytes", "down_wire_bytes", "up_wire_bytes", "estimated_wire_bytes")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FleetResults:
    """The result files of all vehicles of a run.

    Attributes:
        results: one decoded `result.json` a vehicle.
    """

    results: tuple[dict[str, Any], ...]

    @classmethod
    def read(cls, folder: RunFolder) -> "FleetResults":
        """Read the result of every vehicle that left one, in the order of their names."""
        files = sorted(folder.agents.glob("*/result.json"))
        return cls(tuple(json.loads(path.read_text(encoding="utf-8")) for path in files))

    def total(self, key: str) -> float:
        """Return the sum of a number over the vehicles."""
        return float(sum(result[key] for result in self.results))

    def localisation_p95(self) -> dict[str, float | None]:
        """Return the 95 % quantile of the absolute errors of all refined scans of all vehicles together."""
        return {name: self._p95(name) for name in ("longitudinal_m", "lateral_m", "heading_deg")}

    def _p95(self, name: str) -> float | None:
        errors = [error for result in self.results for error in (result["localisation"] or {}).get(name, ())]
        return round(float(np.quantile(np.abs(errors), P95)), 4) if errors else None


def account_traffic(folder: RunFolder, links: Sequence[str] = DEFAULT_LINKS) -> dict[str, Any]:
    """Write the traffic page of a run and return the account of the whole fleet: totals, by kind, by vehicle.

    Everything is computed from the ledgers, once the last message of the last vehicle has been written there: the page,
    this account, `gnd traffic` and the table of a running fleet are the same sums of the same lines.

    Args:
        folder: the run; one whose ledgers cannot be read, or whose page cannot be written, has that as `problem`.
        links: profiles to compare with.
    """
    profiles = tuple(load_link(link) for link in links)
    agents: tuple[AgentTraffic, ...] = ()
    problem = ""
    try:
        agents = tuple(agent_traffic(ledger, profiles) for ledger in read_run(folder.root))
        write_page(folder.traffic_page, folder.root.resolve().name, agents, profiles)
    except (LedgerError, PageError) as error:
        problem = str(error)
        _log.warning("no traffic page: %s", problem)
    return {
        "problem": problem,
        **{name: round(value, 4) for name, value in fleet_totals(agents).items()},
        "by_kind": [asdict(line) for line in fleet_lines(agents)],
        "by_vehicle": {agent.agent: {name: getattr(agent, name) for name in _SIZES} for agent in agents},
    }


def lost_reports(folder: RunFolder, store: SqlStore, layers: Sequence[str] = (DEFAULT_LAYER,)) -> list[str]:
    """Return the ids of reports that a vehicle made but neither the store nor its quarantine can show.

    Args:
        folder: the run; each vehicle's outbox says what it made.
        store: the store of the run.
        layers: that its vehicles report about.
    """
    made: dict[str, str] = {}
    for path in sorted(folder.agents.glob("*/outbox.sqlite")):
        outbox = Outbox(path)
        made |= outbox.states()
        outbox.close()
    stored = {row.report_id for layer in layers for row in store.reports(layer)}
    for layer in layers:
        stored |= store.road_reports(layer)
    return sorted(report_id for report_id, state in made.items() if report_id not in stored and state != "quarantined")


@dataclass(frozen=True, slots=True)
class TileHistory:
    """A tile before and after a run.

    Attributes:
        before: Gaussians of the latest survey, empty where the tile was not mapped.
        after: Gaussians of the newest version.
        tile: the newest version as stored.
        base: that survey's version as stored, None where the tile was not mapped.
    """

    tile: StoredTile
    before: Gaussians
    after: Gaussians
    base: StoredTile | None = None

    def changed_voxels(self) -> int:
        """Return how many voxels differ."""
        delta = diff(self.before, self.after)
        return len(delta.removed) + len(delta.put)


def tile_histories(store: SqlStore, layer: str = DEFAULT_LAYER) -> list[TileHistory]:
    """Return every tile of a store as it was surveyed last and as it is now."""
    return [_history(store, layer, entry.tile, entry.version) for entry in store.heads(layer)]


def _history(store: SqlStore, layer: str, tile: Any, version: int) -> TileHistory:
    head = store.get(layer, tile, version)
    if head is None:
        raise LookupError(f"version {version} of tile {tile.path} was listed but is not there")
    given = [info for info in store.history(layer, tile) if info.kind != "merged"]
    surveys = [
        info.version for info in given if info.kind == "base"
    ]  # what was rolled back since is not the map before
    bases = surveys or [info.version for info in given[:1]]
    base = store.get(layer, tile, bases[-1]) if bases else None
    before = Gaussians.empty() if base is None else base.decode_gaussians().gaussians
    return TileHistory(head, before, head.decode_gaussians().gaussians, base)
