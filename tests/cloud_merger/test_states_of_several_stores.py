"""How far a report has come is answered by the shard whose store holds it, where several stores share a map."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gnd.cloud_merger.states import UNKNOWN_AFTER_S, States
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import change_key, state_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportStates
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.uploads import Upload

IDS = [deterministic_report_id(1_700_000_000_000 + n, "car") for n in range(3)]
KEY = change_key("ndt", TileId(497353963154).district)


@pytest.fixture
def asking(tmp_path: Path, free_port: int) -> Iterator[Bus]:
    """A vehicle's bus; the first report is in one store, the second in the other, the third in none."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    config = BusConfig(connect=(endpoint,))
    with (
        open_router([endpoint]),
        SqliteStore(tmp_path / "a.db") as west,
        SqliteStore(tmp_path / "b.db") as east,
        open_bus(config, name="west") as at_west,
        open_bus(config, name="east") as at_east,
        open_bus(config, name="car") as car,
    ):
        for number, (store, bus) in enumerate(((west, at_west), (east, at_east))):
            store.put_upload(Upload(KEY, b"%d" % number, IDS[number], "car", "packed", 1), "m")
            states = States(store, bus)
            states.open()  # alone, until it turns out that there are several
            states.open(are_several=True)
        yield car


def asked(bus: Bus, *report_ids: str) -> dict[str, str]:
    question = ReportQuestion(report_ids).encode()
    answer = bus.request(state_key("car"), question, kind="change", timeout_s=30)
    return {one.report_id: one.status for one in ReportStates.decode(answer).states}


def test_who_holds_a_report_answers(asking: Bus) -> None:
    for report_id in IDS[:2]:
        assert asked(asking, report_id) == {report_id: "waiting"}


def test_of_several_reports_each_answers_for_its_own(asking: Bus) -> None:
    """What the first to answer leaves out is asked again."""
    found: dict[str, str] = {}
    while left := [one for one in IDS[:2] if one not in found]:
        found |= asked(asking, *left)
    assert found == dict.fromkeys(IDS[:2], "waiting")


def test_what_nobody_holds_is_unknown_late(asking: Bus) -> None:
    began_s = time.monotonic()
    assert asked(asking, IDS[2]) == {IDS[2]: "unknown"}
    assert time.monotonic() - began_s >= UNKNOWN_AFTER_S
