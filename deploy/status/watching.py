"""Look again and again: on a terminal in place, elsewhere a line each time."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gnd.deploy.live import FleetState
from gnd.deploy.live_traffic import LiveLedgers
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.serve.page_vehicles import run_is_going
from gnd.deploy.status.figures import CloudFigures, look_at
from gnd.deploy.status.keys import quitting_by_key
from gnd.deploy.status.raised import raised_by
from gnd.deploy.status.screen import RoomView, one_line, screen
from gnd.deploy.status.thresholds import AlertThresholds
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.gnd_map.errors import GndError
from gnd.schemas.keys import traffic_keys
from gnd.tile_store.location import StoreLocation
from gnd.tile_store.options import to_read
from gnd.tile_store.sqlite_store import SqlStore

_SHARE: Final = 0.1
"""Looking may take this part of the time, however large the store is."""


_NO_SHARD: Final = "GndNoShard"
"""A run that has ended has no shards, and misses none."""


@dataclass(slots=True)
class OperatorRoom:
    """What is looked at, and the look before.

    Attributes:
        location: of the store.
        thresholds: beyond which alerts are raised.
        identity: folder of this program's certificate.
        run: folder of a run, whose vehicles' ledgers are read.
        endpoint: of a router where vehicles are heard; None: none.
    """

    location: StoreLocation
    thresholds: AlertThresholds
    identity: Path | None = None
    run: RunFolder | None = None
    endpoint: str | None = None
    _before: CloudFigures | None = None
    _store: SqlStore | None = field(default=None, repr=False)

    def look(self) -> RoomView:
        """Look once; the store is opened at the first look, and again after one that failed.

        Raises:
            GndError: the store does not answer, the identity cannot be read.
        """
        try:
            self._store = self._store or to_read(self.location)
            figures = look_at(self._store, self.location, self.identity)
        except GndError:
            self.close()
            raise
        before, self._before = self._before, figures
        ended = self.run is not None and self.run.summary.exists()
        raised = (one for one in raised_by(figures, self.thresholds) if not (ended and one.alert == _NO_SHARD))
        return RoomView(figures, tuple(raised), _rate(before, figures))

    def close(self) -> None:
        """Close the store."""
        store, self._store = self._store, None
        if store is not None:
            store.close()

    @contextmanager
    def listening(self) -> Iterator[FleetState | None]:
        """What vehicles say of themselves, while the block runs; None: there is neither a run nor a router."""
        if self.run is None and self.endpoint is None:
            yield None
            return
        state = FleetState(ledgers=LiveLedgers(None if self.run is None else self.run.root))
        with ExitStack() as stack:
            if self.endpoint is not None:
                config = BusConfig(connect=(self.endpoint,), identity=self.identity, patient=True)
                bus = stack.enter_context(open_bus(config, name="status"))
                follow_revoked(bus)
                stack.enter_context(bus.subscribe(traffic_keys(), state.on_traffic))
            yield state


def _rate(before: CloudFigures | None, now: CloudFigures) -> float | None:
    if before is None or now.at_ns <= before.at_ns:
        return None
    return max(now.parts - before.parts, 0) / ((now.at_ns - before.at_ns) / 1e9)


def endpoint_of(run: RunFolder | None) -> str | None:
    """The router of a run that is going; None: it is not."""
    if run is None or not run_is_going(run):
        return None
    try:
        return run.endpoint.read_text(encoding="utf-8").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


def told(view: RoomView, fleet: FleetState | None) -> dict[str, Any]:
    """A look, JSON-able: figures, alerts, and vehicles where somebody listened."""
    values = view.figures.as_dict() | {"alerts": [asdict(one) for one in view.raised], "parts_per_s": view.parts_per_s}
    if fleet is not None:
        with fleet.lock:
            samples, agents = dict(fleet.samples), dict(fleet.ledgers.agents)
        values["vehicles"] = [
            {"vehicle": name}
            | ({"health": samples[name].health, "reports": samples[name].reports} if name in samples else {})
            | ({"drive_km": agents[name].drive_km} if name in agents else {})
            for name in sorted(samples.keys() | agents.keys())
        ]
    return values


def watch_room(room: OperatorRoom, every_s: float, stop: threading.Event, console: Console, *, as_json: bool) -> None:
    """Look every so many seconds until `stop` is set, or q is pressed. A store that does not answer is said, and asked
    again.

    Args:
        room: what is looked at.
        every_s: seconds between two looks, at least.
        stop: ends it.
        console: where it is shown: in place on a terminal, else a line a look.
        as_json: a JSON object a line instead.
    """
    with room.listening() as fleet, ExitStack() as stack:
        stack.callback(room.close)
        is_shown = console.is_terminal and not as_json
        hint = "q or Ctrl-C ends" if stack.enter_context(quitting_by_key(stop)) else "Ctrl-C ends"
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if is_shown else None
        while not stop.is_set():
            begin_s = time.monotonic()
            if fleet is not None:
                fleet.ledgers.refresh()
            has_answered = _tell(room, fleet, live, console, hint, as_json=as_json)
            took_s = time.monotonic() - begin_s if has_answered else 0.0  # what failed may have waited long
            stop.wait(max(every_s, took_s / _SHARE))


def _tell(
    room: OperatorRoom, fleet: FleetState | None, live: Live | None, console: Console, hint: str, *, as_json: bool
) -> bool:
    """Look and show it; whether the store answered."""
    try:
        view = room.look()
    except GndError as error:
        _say(live, console, json.dumps({"error": str(error)}) if as_json else f"CRITICAL: {error}")
        return False
    if live is not None:
        live.update(screen(view, fleet, hint), refresh=True)
    else:
        _say(None, console, json.dumps(told(view, fleet)) if as_json else one_line(view, fleet))
    return True


def _say(live: Live | None, console: Console, line: str) -> None:
    if live is not None:
        live.update(Text(line, style="bold red"), refresh=True)
    else:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
        console.file.flush()
