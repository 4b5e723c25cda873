"""Rows from memory against rows from the file: the same, whatever has happened to the tile between two looks."""

from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from store_helpers import EAGER, TILE, report, tile_of_voxels

from gnd.tile_store.rows_kept import RowsKept
from gnd.tile_store.sqlite_store import SqliteStore

LAYER = "ndt"
STEPS = st.lists(st.sampled_from(["report", "report", "report", "part", "base", "rollback", "look"]), max_size=14)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(STEPS, st.randoms(use_true_random=False), st.sampled_from([1, 1 << 20]))
def test_a_look_with_a_memory_is_a_look_at_the_file(tmp_path_factory, steps, random, most_bytes):
    path: Path = tmp_path_factory.mktemp("rows") / "s.db"
    with SqliteStore(path, EAGER) as store:
        store._rows = RowsKept(most_bytes)
        store.put_tiles([tile_of_voxels(TILE, 1)])
        for number, step in enumerate(steps):
            if step == "base":
                store.put_tiles([tile_of_voxels(TILE, 2 + number)])
            elif step == "rollback":
                store.rollback(LAYER, TILE, 1)
            elif step != "look":
                store.put_reports([report(random.randrange(40), vehicle=f"v{random.randrange(3)}")])
            if step == "look" or random.random() < 0.5:
                with SqliteStore(path, EAGER, read_only=True) as fresh:
                    one, other = store.in_play(LAYER, TILE), fresh.in_play(LAYER, TILE)
                places = [[(row.window, row.seq) for row in found.reports] for found in (one, other)]
                assert one.reports == other.reports
                assert places[0] == places[1]
                assert one.mark == other.mark
