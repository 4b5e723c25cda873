"""A vehicle speaks of itself when there is something to say."""

from dataclasses import replace

from waiting import wait_until

from fleet_bus.bus import open_bus
from fleet_bus.config import BusConfig
from fleet_bus.ledger import Ledger
from schemas.traffic import TrafficSample
from vehicle_agent.telemetry import EVERY_M, Telemetry

START = TrafficSample("v", 1, 0.0, (), 0, 0, 0.65, 2.2, "lost", 0, 0)


def test_samples_go_out_by_way_and_by_event_and_at_the_end(endpoint: str) -> None:
    now, looks, ledger = START, 0, Ledger("v")

    def sample() -> TrafficSample:
        nonlocal looks
        looks += 1
        return now

    def said() -> int:
        return sum(line.messages for line in ledger.totals() if (line.kind, line.direction) == ("control", "up"))

    def looked_again() -> int:
        before = looks
        wait_until(lambda: looks > before + 2)
        return said()

    with open_bus(BusConfig(connect=(endpoint,)), ledger) as bus:
        telemetry = Telemetry(bus, "v", sample, look_s=0.01)
        wait_until(lambda: said() == 1)
        now = replace(START, odometer_m=EVERY_M - 1.0, tiles=3)
        assert looked_again() == 1
        now = replace(now, odometer_m=EVERY_M)
        assert looked_again() == 2
        now = replace(now, health="good")
        assert looked_again() == 3
        now = replace(now, reports=1)
        assert looked_again() == 4
        now = replace(now, scans_taken_back=7)
        assert looked_again() == 4  # comes in rows
        now = replace(now, tiles_doubtful=1, doubts=(0, 1))
        assert looked_again() == 5
        telemetry.close()
        assert said() == 6
