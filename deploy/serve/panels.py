"""What stands beside the map: the work list of changes, the traffic against mobile links, how the cloud stands.

Each is computed when a browser asks and kept for a while: the longer it took, the longer.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final, Generic, TypeVar

from gnd.deploy.run_folder import RunFolder
from gnd.deploy.serve.page_map import PageMap
from gnd.deploy.serve.work_list import WorkList
from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger_file import read_run
from gnd.fleet_bus.links import load_link
from gnd.fleet_bus.traffic import DEFAULT_LINKS, AgentTraffic, agent_traffic, fleet_lines, fleet_totals, kind_text
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.status import WORDS, status_of

MOST_ROWS: Final = 100
_KEPT_S: Final = 2.0
_SHARE: Final = 0.1
_T = TypeVar("_T")


class KeptAnswer(Generic[_T]):
    """A value that is computed anew when it is asked for and not too young.

    Args:
        compute: makes the value; one thread at a time.
    """

    def __init__(self, compute: Callable[[], _T]) -> None:
        self._compute, self._lock = compute, threading.Lock()
        self._value: list[_T] = []
        self._until_s = 0.0

    def get(self) -> _T:
        """The value."""
        with self._lock:
            begin_s = time.monotonic()
            if not self._value or begin_s >= self._until_s:
                self._value = [self._compute()]
                end_s = time.monotonic()
                self._until_s = end_s + max(_KEPT_S, (end_s - begin_s) / _SHARE)
            return self._value[0]

    def forget(self) -> None:
        """Compute it anew when it is asked for next."""
        with self._lock:
            self._value = []


def traffic(run: RunFolder | None) -> dict[str, Any]:
    """What the vehicles of a run have sent and received, and how much of 3G, 4G and 5G that is; `problem` says why
    there is nothing to say.
    """
    if run is None:
        return {"problem": "a store alone has no account of traffic: serve the folder of a run"}
    links = tuple(load_link(name) for name in DEFAULT_LINKS)
    try:
        agents = tuple(agent_traffic(ledger, links) for ledger in read_run(run.root))
    except LedgerError as error:
        return {"problem": f"no account of traffic yet: {error}"}
    lines = [asdict(line) | {"kind": kind_text(line.kind)} for line in fleet_lines(agents)]
    return {
        "problem": "",
        "fleet": fleet_totals(agents) | {"lines": lines},
        "links": [_link(link.name, agents) for link in links],
        "vehicles": [_agent(agent) for agent in agents],
    }


def _agent(agent: AgentTraffic) -> dict[str, Any]:
    names = ("agent", "link", "drive_km", "drive_s", "up_wire_bytes", "down_wire_bytes", "along")
    return {name: getattr(agent, name) for name in names}


def _link(name: str, agents: tuple[AgentTraffic, ...]) -> dict[str, Any]:
    """The vehicle that needs most of a link, and the longest wait of any message, by direction."""
    told: dict[str, Any] = {"link": name}
    for direction in ("down", "up"):
        uses = [use for agent in agents for use in agent.links if (use.link, use.direction) == (name, direction)]
        told[f"{direction}_share"] = max((use.share for use in uses), default=0.0)
        told[f"{direction}_wait_s"] = max((use.longest_wait_s for use in uses), default=0.0)
    return told


def status(store: SqlStore) -> dict[str, Any]:
    """How the cloud stands: as `gnd map status --json`, the long lists cut."""
    told = status_of(store)
    waiting = told["waiting_for_confirmation"]
    waiting["claims"] = [
        one | {"why": WORDS.get(one["reason"], one["reason"])} for one in waiting["claims"][:MOST_ROWS]
    ]
    for name in ("set_aside", "to_merge", "named_vehicles"):
        told[name] = told[name][:MOST_ROWS]
    return told


@dataclass(frozen=True, slots=True)
class Panels:
    """What stands beside one map.

    Attributes:
        work: the work list, and who writes to it.
        changes: the work list as it was a moment ago.
        traffic, status: each as the function of that name gives it.
    """

    work: WorkList
    changes: KeptAnswer[dict[str, Any]]
    traffic: KeptAnswer[dict[str, Any]]
    status: KeptAnswer[dict[str, Any]]

    @classmethod
    def of(cls, shown: PageMap, run: RunFolder | None, writing: SqlStore | None = None) -> "Panels":
        """The panels of a map; `writing` is its store where decisions may be taken."""
        work = WorkList(shown, writing)
        return cls(
            work,
            KeptAnswer(work.compute),
            KeptAnswer(lambda: traffic(run)),
            KeptAnswer(lambda: status(shown.store)),
        )
