"""What a person sees of the traffic while a fleet runs."""

import io
from dataclasses import replace

import pytest
from rich.console import Console

from deploy.live import FleetState, live_view, render
from deploy.live_traffic import Rate, rate_between
from deploy.map_use import MapUse
from fleet_bus.links import UNLIMITED, LinkProfile
from schemas.traffic import TrafficLine, TrafficSample

LINK = LinkProfile("test", down_bit_s=8_000_000, up_bit_s=800_000)


class Clock:
    """Monotonic time that a test moves, s."""

    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


def sample(t_s: int, *lines: TrafficLine, wire: tuple[int, int] = (0, 0), vehicle: str = "vehicle-00") -> TrafficSample:
    return TrafficSample(vehicle, t_s * 10**9, 500.0 * t_s, lines, *wire, 0.65, 2.2, "good", 3, 1)


def shown(state: FleetState) -> str:
    console = Console(width=140, file=io.StringIO(), record=True)
    console.print(render(state))
    return console.export_text()


def row_of(text: str, first: str) -> list[str]:
    return next(line for line in text.splitlines() if line.startswith(first)).split()


def state_of(clock: Clock) -> FleetState:
    return FleetState(links={"vehicle-00": LINK}, clock=clock)


def test_kinds_have_their_bytes_and_rates_per_km():
    state = state_of(Clock())
    lines = (
        TrafficLine("tile", "down", 4, 250_000),
        TrafficLine("change", "up", 1, 5_000),
        TrafficLine("ack", "down", 1, 40),
    )
    for vehicle in ("vehicle-00", "vehicle-01"):
        state.on_traffic("key", sample(2, *lines, wire=(6_000, 260_000), vehicle=vehicle).encode())
    text = shown(state)
    # Two vehicles, 1 km each.
    assert row_of(text, "tile") == ["tile", "500.0", "250.0", "–", "–"]
    assert row_of(text, "change") == ["change", "–", "–", "10.0", "5.0"]
    assert row_of(text, "on the wire")[3:] == ["520.0", "260.0", "12.0", "6.0"]
    assert "vehicle-01" in text


def test_the_rate_between_two_samples_is_set_against_the_link():
    clock = Clock()
    state = state_of(clock)
    state.on_traffic("key", sample(1, wire=(1_000, 10_000)).encode())
    assert "kB/s" not in shown(state)
    clock.now_s += 2.0
    state.on_traffic("key", sample(2, wire=(6_000, 110_000)).encode())
    text = shown(state)
    # 50 kB/s of 1000 kB/s down, 2.5 kB/s of 100 kB/s up.
    assert "50.0 kB/s 5 %" in text
    assert "2.5 kB/s 2.5 %" in text
    clock.now_s += 60.0
    assert "kB/s" not in shown(state), "a rate of long ago is none"


def test_a_restarted_vehicle_has_no_negative_rate():
    older, newer = sample(1, wire=(500, 500)), sample(2, wire=(100, 900))
    assert rate_between(older, 0.0, newer, 1.0) is None
    assert rate_between(newer, 1.0, newer, 1.0) is None
    assert rate_between(older, 0.0, sample(2, wire=(700, 900)), 2.0) == Rate(100.0, 200.0, 2.0)


def test_a_link_without_limits_has_no_share():
    rate = Rate(1000.0, 2000.0, 0.0)
    assert rate.share(UNLIMITED, "down") is None
    assert rate.share(LINK, "up") == pytest.approx(0.01)
    clock = Clock()
    state = FleetState(clock=clock)
    state.on_traffic("key", sample(1).encode())
    clock.now_s += 1.0
    state.on_traffic("key", sample(2, wire=(1000, 4000)).encode())
    text = shown(state)
    assert "4.0 kB/s" in text
    assert "%" not in text


def test_late_and_unreadable_samples_change_nothing():
    state = state_of(Clock())
    state.on_traffic("key", sample(5, TrafficLine("tile", "down", 1, 1000)).encode())
    before = row_of(shown(state), "tile")
    state.on_traffic("key", sample(4, TrafficLine("tile", "down", 1, 900)).encode())
    state.on_traffic("key", b"\xff\xff")
    text = shown(state)
    assert row_of(text, "tile") == before
    assert "unreadable sample on key" in text


def test_before_the_first_sample_there_are_only_totals():
    text = shown(state_of(Clock()))
    assert "0 reports" in text
    assert "on the wire" not in text


def test_a_narrow_terminal_keeps_a_vehicle_in_a_line():
    clock = Clock()
    state = state_of(clock)
    for t_s in (1, 2):
        state.on_traffic("key", sample(t_s, wire=(900_000 * t_s, 800_000 * t_s)).encode())
        clock.now_s += 1.0
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(render(state, console.width))
    row = " ".join(row_of(console.export_text(), "vehicle-00"))
    assert row == "vehicle-00 good 1000 m 1.60 MB 800.0 kB/s 80 % 1.80 MB 900.0 kB/s 900 %"
    assert "37.24226 126.0507" in shown(state)


def test_a_vehicle_that_doubts_itself_is_seen_to():
    state = state_of(Clock())
    state.on_traffic("key", sample(1).encode())
    assert "doubts" not in shown(state)
    doubtful = replace(sample(2), scans_taken_back=7, tiles_held_back=2, tiles_doubtful=3, doubts=(2, 0, 0, 1))
    state.on_traffic("key", doubtful.encode())
    assert "3 tiles (2 held back), 7 scans" in shown(state)
    assert state.samples["vehicle-00"].doubts_in_words == {"explained_by_shift": 2, "estimates_disagree": 1}


def test_without_a_terminal_a_line_tells_the_same():
    state, console = state_of(Clock()), Console(width=60, file=io.StringIO())
    state.on_traffic(
        "key", sample(2, TrafficLine("tile", "down", 1, 7_000), TrafficLine("control", "up", 1, 90)).encode()
    )
    with live_view(state, console) as view:
        view.refresh()
        view.refresh()
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 1, "one line, and no second one at once"
    assert lines[0].endswith("kB/km down tile 7.0; up control 0.1")


def test_the_table_says_how_much_of_the_map_under_the_wheels_others_have_renewed() -> None:
    state = FleetState()
    for n in range(3):
        state.on_traffic("", sample(1, vehicle=f"vehicle-0{n}").encode())
    assert "map renewed" not in shown(state)
    state.maps = {"vehicle-00": MapUse(0.0, None, None), "vehicle-01": MapUse(0.8, 30.0, 12.4)}
    text = shown(state)
    assert "0 %" in " ".join(row_of(text, "vehicle-00"))
    assert "80 %, 12 s old" in " ".join(row_of(text, "vehicle-01"))
    assert "%" not in " ".join(row_of(text, "vehicle-02"))
