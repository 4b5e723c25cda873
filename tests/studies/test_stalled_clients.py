"""Clients that are stopped, and parts that are killed, in real processes: nobody else waits."""

import pytest

from studies import outage, stalled

MOST_S = 12.0
"""Beside other tests; on a machine that does nothing else it is a third of a second (docs/results.md)."""

pytestmark = pytest.mark.xdist_group("shards")


@pytest.mark.slow
def test_stopped_clients_hold_up_nobody() -> None:
    """Two of five, one of which asks for the whole map in several threads; before, all waited until they went on."""
    outcome = stalled.measure(stalled.Plan(clients=5, stopped=2, greedy=1, calm_s=1.0, stopped_s=5.0, after_s=2.0))
    assert {what: wait_s for what, wait_s in outcome.stopped.items() if wait_s > 1.5} == {}
    assert outcome.missed < 0.05
    assert outcome.back == 2


@pytest.mark.slow
def test_what_is_killed_serves_again_soon() -> None:
    found = outage.measure(kills=1, between_s=3.0)
    assert found.keys() == outage.VICTIMS.keys()
    assert {(who, what): s for who, services in found.items() for what, s in services.items() if s > MOST_S} == {}
