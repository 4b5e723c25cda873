"""What a person sees of the traffic while a fleet runs."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from gnd.deploy.live import FleetState, live_view, render
from gnd.deploy.live_traffic import LiveLedgers, Rate
from gnd.deploy.map_use import MapUse
from gnd.fleet_bus.ledger import Direction, Ledger
from gnd.fleet_bus.links import UNLIMITED, LinkProfile
from gnd.fleet_bus.wire import WireBytes
from gnd.schemas.traffic import TrafficSample

LINK = LinkProfile("test", down_bit_s=8_000_000, up_bit_s=800_000)


class Clock:
    """Monotonic time that a test moves, s."""

    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


def sample(t_s: int, *, vehicle: str = "vehicle-00") -> TrafficSample:
    return TrafficSample(vehicle, t_s * 10**9, 500.0 * t_s, (), 0, 0, 0.65, 2.2, "good", 3, 1)


class Fleet:
    """A run folder whose vehicles write their ledgers, and what is shown of it."""

    def __init__(self, folder: Path, link: LinkProfile = LINK) -> None:
        self.folder, self.clock = folder, Clock()
        self.ledgers: dict[str, Ledger] = {}
        self.state = FleetState(links={"vehicle-00": link}, ledgers=LiveLedgers(folder, clock=self.clock))

    def drive(self, t_s: int, *messages: tuple[str, Direction, int], wire=(0, 0), vehicle: str = "vehicle-00") -> None:
        """A vehicle sends its sample of that second, and its ledger has messages and a reading of the wire."""
        ledger = self.ledgers.setdefault(vehicle, Ledger(vehicle, self.folder / "ledger" / f"{vehicle}.jsonl"))
        ledger.set_position(500.0 * t_s, t_s * 10**9)
        for kind, way, size in messages:
            ledger.record(way, kind, size, head_bytes=0)
        ledger.record_wire(WireBytes(*wire))
        self.state.on_traffic("key", sample(t_s, vehicle=vehicle).encode())

    def shown(self) -> str:
        self.state.ledgers.refresh(now=True)
        return shown(self.state)


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path)


def shown(state: FleetState, width: int = 140) -> str:
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(render(state, width))
    return console.export_text()


def row_of(text: str, first: str) -> list[str]:
    return next(line for line in text.splitlines() if line.startswith(first)).split()


def test_kinds_have_their_bytes_and_rates_per_km(fleet):
    for vehicle in ("vehicle-00", "vehicle-01"):
        messages = (("tile", "down", 250_000), ("change", "up", 5_000), ("ack", "down", 40))
        fleet.drive(2, *messages, wire=(6_000, 260_000), vehicle=vehicle)
    text = fleet.shown()
    # Two vehicles, 1 km each; what no message explains is the session's.
    assert row_of(text, "tile ") == ["tile", "500.320", "250.2", "–", "–"]
    assert row_of(text, "change") == ["change", "–", "–", "10.320", "5.2"]
    assert row_of(text, "session") == ["session", "19.280", "9.6", "1.680", "0.8"]
    assert row_of(text, "all ") == ["all", "520.000", "260.0", "12.000", "6.0"]
    assert "vehicle-01" in text


def test_the_rate_between_two_looks_is_set_against_the_link(fleet):
    fleet.drive(1, wire=(1_000, 10_000))
    assert "kB/s" not in fleet.shown()
    fleet.clock.now_s += 2.0
    fleet.drive(2, wire=(6_000, 110_000))
    text = fleet.shown()
    # 50 kB/s of 1000 kB/s down, 2.5 kB/s of 100 kB/s up.
    assert "50.0 kB/s 5 %" in text
    assert "2.5 kB/s 2.5 %" in text
    fleet.clock.now_s += 60.0
    assert "kB/s" not in fleet.shown(), "a rate of long ago is none"


def test_a_restarted_vehicle_has_no_negative_rate(fleet):
    fleet.drive(1, wire=(500, 500))
    fleet.shown()
    fleet.clock.now_s += 2.0
    fleet.ledgers["vehicle-00"] = Ledger("vehicle-00", fleet.folder / "ledger" / "vehicle-00.jsonl", lambda: 7)
    fleet.drive(2, wire=(100, 900))
    fleet.shown()
    assert fleet.state.ledgers.rates["vehicle-00"] == Rate(50.0, 450.0, fleet.clock.now_s), "a session more"
    assert fleet.state.ledgers.agents["vehicle-00"].down_wire_bytes == 1400


def test_a_link_without_limits_has_no_share(tmp_path):
    rate = Rate(1000.0, 2000.0, 0.0)
    assert rate.share(UNLIMITED, "down") is None
    assert rate.share(LINK, "up") == pytest.approx(0.01)
    fleet = Fleet(tmp_path, UNLIMITED)
    fleet.drive(1)
    fleet.shown()
    fleet.clock.now_s += 1.0
    fleet.drive(2, wire=(1000, 4000))
    text = fleet.shown()
    assert "4.0 kB/s" in text
    assert "%" not in text


def test_late_and_unreadable_samples_change_nothing(fleet):
    fleet.drive(5)
    before = row_of(fleet.shown(), "vehicle-00")
    fleet.state.on_traffic("key", sample(4).encode())
    fleet.state.on_traffic("key", b"\xff\xff")
    text = fleet.shown()
    assert row_of(text, "vehicle-00") == before
    assert "unreadable sample on key" in text


def test_the_way_goes_on_between_two_samples(fleet):
    fleet.drive(1)
    fleet.ledgers["vehicle-00"].set_position(777.0, 2 * 10**9)
    fleet.ledgers["vehicle-00"].record_wire(WireBytes(1, 1))
    assert "777 m" in fleet.shown()


def test_before_the_first_sample_there_are_only_totals():
    text = shown(FleetState())
    assert "0 reports" in text
    assert "on the wire" not in text


def test_a_narrow_terminal_keeps_a_vehicle_in_a_line(fleet):
    for t_s in (1, 2):
        fleet.drive(t_s, wire=(900_000 * t_s, 800_000 * t_s))
        fleet.shown()
        fleet.clock.now_s += 1.0
    row = " ".join(row_of(shown(fleet.state, 80), "vehicle-00"))
    assert row == "vehicle-00 good 1000 m 1.60 MB 800.0 kB/s 80 % 1.80 MB 900.0 kB/s 900 %"
    assert "37.24226 126.0507" in shown(fleet.state)


def test_a_vehicle_that_doubts_itself_is_seen_to():
    state = FleetState()
    state.on_traffic("key", sample(1).encode())
    assert "doubts" not in shown(state)
    doubtful = replace(sample(2), scans_taken_back=7, tiles_held_back=2, tiles_doubtful=3, doubts=(2, 0, 0, 1))
    state.on_traffic("key", doubtful.encode())
    assert "3 tiles (2 held back), 7 scans" in shown(state)
    assert state.samples["vehicle-00"].doubts_in_words == {"explained_by_shift": 2, "estimates_disagree": 1}


def test_without_a_terminal_a_line_tells_the_same(fleet):
    fleet.drive(2, ("tile", "down", 7_000), ("telemetry", "up", 90), wire=(250, 7_160))
    console = Console(width=60, file=io.StringIO())
    with live_view(fleet.state, console) as view:
        view.refresh()
        view.refresh()
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 1, "one line, and no second one at once"
    assert lines[0].endswith("on the wire 7.4 kB/km: tiles 7.2, all else 0.2")


def test_what_stays_on_the_terminal_is_the_whole_account(fleet):
    """The last bytes of a run come after the table was drawn last."""
    console = Console(width=140, file=io.StringIO(), force_terminal=True)
    with live_view(fleet.state, console) as view:
        fleet.drive(2, wire=(1_000, 2_000))
        view.refresh()
        fleet.ledgers["vehicle-00"].record_wire(WireBytes(1_234, 5_678))
        view.refresh()
    assert isinstance(console.file, io.StringIO)
    assert "5.678" in console.file.getvalue()
    assert "1.234" in console.file.getvalue()


def test_the_table_says_how_much_of_the_map_under_the_wheels_others_have_renewed():
    state = FleetState()
    for n in range(3):
        state.on_traffic("", sample(1, vehicle=f"vehicle-0{n}").encode())
    assert "map renewed" not in shown(state)
    state.maps = {"vehicle-00": MapUse(0.0, None, None), "vehicle-01": MapUse(0.8, 30.0, 12.4)}
    text = shown(state)
    assert "0 %" in " ".join(row_of(text, "vehicle-00"))
    assert "80 %, 12 s old" in " ".join(row_of(text, "vehicle-01"))
    assert "%" not in " ".join(row_of(text, "vehicle-02"))
