"""A vehicle speaks of itself when there is something to say, by its drive and not by the clock."""

from dataclasses import replace

from waiting import wait_until

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.schemas.keys import traffic_key
from gnd.schemas.traffic import TrafficLine, TrafficSample
from gnd.vehicle_agent.link.telemetry import EVERY_M, EVERY_S, HEALTH_S, Telemetry

LINES = (TrafficLine("tile", "down", 3, 999), TrafficLine("change", "up", 1, 70))
START = TrafficSample("v", 1, 0.0, LINES, 0, 0, 0.65, 2.2, "lost", 0, 0)


def test_samples_go_out_by_way_and_by_event_and_at_the_end(endpoint: str) -> None:
    now, looks, ledger = START, 0, Ledger("v")

    def sample() -> TrafficSample:
        nonlocal looks
        looks += 1
        return now

    def said() -> int:
        return sum(line.messages for line in ledger.totals() if (line.kind, line.direction) == ("telemetry", "up"))

    def looked_again() -> int:
        before = looks
        wait_until(lambda: looks > before + 2)
        return said()

    def after(s: float) -> int:
        return 1 + int(s * 1e9)

    heard: list[TrafficSample] = []
    with open_bus(BusConfig(connect=(endpoint,))) as cloud, open_bus(BusConfig(connect=(endpoint,)), ledger) as bus:
        cloud.subscribe(traffic_key("v"), lambda _k, body: heard.append(TrafficSample.decode(body)), kind="telemetry")
        telemetry = Telemetry(bus, "v", sample, look_s=0.01)
        assert looked_again() == 0, "it has not found itself yet"
        now = replace(START, health="degraded")
        assert looked_again() == 0, "a moment later it is well"
        now = replace(START, health="good")
        wait_until(lambda: said() == 1)
        now = replace(now, odometer_m=EVERY_M - 1.0, tiles=3, reports=1, scans_taken_back=7)
        assert looked_again() == 1, "what the cloud knows is not said again, and scans come in rows"
        now = replace(now, odometer_m=EVERY_M)
        assert looked_again() == 2
        now = replace(now, t_ns=after(HEALTH_S) - 1, health="lost")
        assert looked_again() == 2, "health that wavers is told after a while only"
        now = replace(now, t_ns=after(HEALTH_S))
        assert looked_again() == 3
        now = replace(now, t_ns=after(HEALTH_S + EVERY_S) - 1)
        assert looked_again() == 3, "a vehicle that stands says little"
        now = replace(now, t_ns=after(HEALTH_S + EVERY_S))
        assert looked_again() == 4
        now = replace(now, t_ns=after(2 * HEALTH_S + EVERY_S), tiles_doubtful=1, doubts=(0, 1))
        assert looked_again() == 5
        telemetry.close()
        assert said() == 6
        wait_until(lambda: len(heard) >= 2 and heard[-1].lines == LINES)
        assert all(sample.lines == () for sample in heard[:-1]), "totals by kind go with the last sample only"
        assert heard[-1].doubts == (0, 1)
