"""What parks is no change, however many saw it within the hour; what stays is one."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from merger_world import TILE, change_of, gaussians_of, report_of, seen_by

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.map_parameters import text_of, with_text
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.parked import PARKED_PLACE_GOINGS
from gnd.cloud_merger.stored import decode_state
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.gnd_map import vehicle_shape
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

GRID = VoxelGrid.of(TILE)
HOUR_NS = 3600 * 1_000_000_000
START_NS = 1_800_000_000_000_000_000
FLOOR = 40
ROAD = (0.0, 0.0, 0.0, 0.28, 0.28, 0.02)
BODY = (0.0, 0.0, -0.1, 0.28, 0.28, 0.22)
WALL = (0.0, 0.0, 0.0, 0.28, 0.28, 0.28)


def ids(columns, rows, floors):
    return GRID.voxel_id(*(x.ravel() for x in np.meshgrid(columns, rows, floors))).tolist()


STREET = dict.fromkeys(ids(range(4, 26), range(4, 26), [FLOOR]), ROAD)
CAR = dict.fromkeys(ids(range(10, 14), range(10, 12), [FLOOR + 1]), BODY)
HOUSE = dict.fromkeys(ids(range(8, 20), range(16, 24), range(FLOOR + 1, FLOOR + 6)), WALL)
SEEN = sorted({*STREET, *CAR, *HOUSE})


class Street:
    """A store with a street and a worker; vehicles come by at given hours."""

    def __init__(self, path, **store):
        self.config = ShardConfig(store_path=path)
        self.now_ns = START_NS
        self.store = SqliteStore(path, StoreConfig(merge_delay_s=0.0, **store), now_ns=lambda: self.now_ns)
        self.base = gaussians_of(STREET)
        self.store.put_tiles([Tile(TILE, 1, self.base)])
        self.number = 0

    def head(self):
        return self.store.get("ndt", TILE).decode_gaussians().gaussians

    def sees(self, vehicle, hour, *things, sensor="VLP-16"):
        """A vehicle drives by and sees these things, and nothing else that the newest map does not hold."""
        self.now_ns = START_NS + round(hour * HOUR_NS)
        self.number += 1
        head, there = self.head(), {voxel: state for thing in things for voxel, state in thing.items()}
        held = set(head.voxel_id.tolist())
        changed = {v: s for v, s in there.items() if v not in held}
        changed |= {v: None for v in held & {*CAR, *HOUSE} if v not in there}
        change = change_of(head, SEEN, seen_by(vehicle, changed))
        times = {"first_ns": self.now_ns - 10**9, "last_ns": self.now_ns}
        report = replace(report_of(self.number, change, vehicle=vehicle), sensor_model=sensor, **times)
        ((tile, body),) = split(report)
        self.store.put_reports([ReportRow(report.report_id, "ndt", tile, vehicle, self.now_ns, body, change.base_sha)])
        worker = Worker(self.store, self.config)
        while claims := self.store.claim("one", 4, 30.0):
            self.store.publish(worker.merge(claims))

    def holds(self, thing):
        """The share of a thing that the map holds."""
        return np.isin(list(thing), self.head().voxel_id).mean()

    def waiting(self):
        return {one.reason for one in self.store.waiting_changes()}


@pytest.fixture(params=[64, 3])  # reports in a window: all in one, and many windows
def street(tmp_path, request):
    made = Street(tmp_path / "map.sqlite", window_reports=request.param)
    yield made
    assert {one.status for one in Verifier(made.store, made.config).history("ndt", TILE)} <= {"given", "same"}
    made.store.close()


def test_a_parked_car_is_no_change_however_many_see_it_within_the_hour_and_a_house_is(street):
    for k in range(9):
        street.sees(f"car-{k}", k / 9, CAR, HOUSE)
    assert street.holds(HOUSE) == 1.0
    assert street.holds(CAR) == 0.0
    assert street.waiting() == {"parked"}


def test_what_has_the_shape_of_a_car_and_stays_is_published_after_a_night(street):
    for k, hour in enumerate([0, 0.5, 8, 14, 17.5]):
        street.sees(f"car-{k}", hour, CAR)
        assert street.holds(CAR) == 0.0
    street.sees("car-9", 18.5, CAR)
    assert street.holds(CAR) == 1.0
    assert street.waiting() == set()


def test_a_place_that_was_free_in_between_begins_anew_and_waits_longer(street):
    for k, (hour, there) in enumerate([(0, 1), (1, 1), (10, 0), (11, 0), (12, 1), (13, 1), (25, 1), (35, 1)]):
        street.sees(f"car-{k}", hour, *([CAR] if there else []))
    assert street.holds(CAR) == 0.0
    for k, hour in enumerate([48, 61, 75, 90]):
        street.sees(f"later-{k}", hour, CAR)
    assert street.holds(CAR) == 1.0


def test_one_vehicle_alone_makes_no_parked_car_a_change(street):
    for hour in (0, 0.2, 0.4):
        street.sees("car", hour, CAR)
    assert street.holds(CAR) == 0.0


def test_a_lidar_of_few_layers_that_misses_a_thing_does_not_keep_it_from_the_map(street):
    for k, hour in enumerate(range(0, 21, 2)):
        street.sees(f"car-{k}", hour, CAR)
        if k % 4 == 3:
            street.sees(f"few-{k}", hour + 1, sensor="Scala")
    assert street.holds(CAR) == 1.0


def test_a_late_report_from_before_the_thing_came_does_not_end_its_stay(tmp_path):
    street = Street(tmp_path / "map.sqlite", window_reports=2)
    for k, hour in enumerate([10, 11, 12, 20]):
        street.sees(f"car-{k}", hour, CAR)
    street.sees("late", 5)
    street.sees("car-9", 29, CAR)
    assert street.holds(CAR) == 1.0
    street.store.close()


def test_the_order_in_which_reports_are_merged_changes_nothing(tmp_path):
    """Late reports count at the time of what they saw: the place was free in between."""
    found = []
    for turn, order in enumerate([(0, 1, 2, 3), (0, 3, 1, 2), (3, 2, 1, 0)]):
        street = Street(tmp_path / f"{turn}.sqlite", window_s=10**6)
        seen = [("a", 0, CAR), ("b", 1, CAR), ("c", 13, None), ("d", 30, CAR)]
        for k in order:
            name, hour, thing = seen[k]
            street.sees(name, hour, *([thing] if thing else []))
        found.append((street.holds(CAR), street.waiting()))
        street.store.close()
    assert found == [(0.0, {"parked"})] * 3


def test_it_may_be_switched_off(tmp_path):
    street = Street(tmp_path / "map.sqlite")
    street.config = replace(street.config, confirmation=ConfirmationParameters(parked_h=0.0))
    for k in range(3):
        street.sees(f"car-{k}", k / 9, CAR)
    assert street.holds(CAR) == 1.0
    street.store.close()


def test_maps_that_were_made_before_are_computed_as_they_were_made():
    """Their parameters do not name it."""
    text = text_of(ShardConfig(confirmation=ConfirmationParameters(parked_h=0.0)))
    old = text.replace('"parked_h":0.0,', "")
    assert old != text
    assert with_text(ShardConfig(), old).confirmation.parked_h == 0.0


def test_places_from_which_things_went_are_remembered_and_the_memory_travels(tmp_path):
    street = Street(tmp_path / "map.sqlite", window_reports=2)
    for k in range(36):  # a car comes and goes, six vehicles meet it, six do not
        street.sees(f"car-{k}", k, *([CAR] if k // 6 % 2 == 0 else []))
    journal = street.store.in_play("ndt", TILE)
    memory = decode_state(TILE, journal.memory).memory
    goings = memory.parked["goings"][np.isin(memory.parked["voxel_id"], list(CAR))]
    assert len(goings) == len(CAR)
    assert (goings >= PARKED_PLACE_GOINGS).all()
    assert (TileMemory.decode(memory.encode()).parked == memory.parked).all()
    street.store.close()


def test_a_memory_of_before_has_nothing_parked():
    data = zstandard.ZstdDecompressor().decompress(TileMemory().encode())
    n = 4 + int.from_bytes(data[:4], "little")
    head = json.loads(data[4:n])
    del head["parked"]
    old = json.dumps(head | {"format": 1}).encode()
    body = zstandard.ZstdCompressor().compress(len(old).to_bytes(4, "little") + old + data[n:])
    assert len(TileMemory.decode(body).parked) == 0


def test_every_bound_of_a_vehicles_shape_travels_with_the_map():
    """A release with another bound knows that it computes another map."""
    bounds = [
        value for name, value in vars(vehicle_shape).items() if re.fullmatch(r"[A-Z][A-Z_]*", name) and name != "BOUNDS"
    ]
    numbers = [number for bound in bounds for number in (bound if isinstance(bound, tuple) else (bound,))]
    assert sorted(numbers) == sorted(vehicle_shape.BOUNDS.values())
    text = text_of(ShardConfig()).replace('"top_most_m":2.3', '"top_most_m":2.4')
    with pytest.raises(MergerError, match=r"vehicle_shape\.top_most_m is 2\.4; it is 2\.3"):
        with_text(ShardConfig(), text)
