"""The page on a store in PostgreSQL: it answers as of the file it was copied from, is followed, and decided in."""

import time
from collections.abc import Callable
from pathlib import Path

from click.testing import CliRunner
from page_testing import EAST, HERE, ServedPage, columns_of, live_street, served, street_tile

from gnd.deploy.cli import gnd
from gnd.tile_store.location import open_store

ASKED = ("tiles?box=-100,-100,100,100", "changes", f"tiles/{EAST.morton}/history")


def answers(page: ServedPage) -> dict[str, object]:
    return {path: page.value(f"/api/{path}") for path in ASKED}


def test_a_store_in_postgresql_is_shown_followed_and_decided_in(
    tmp_path: Path, new_database: Callable[[], str]
) -> None:
    url = new_database()
    with live_street(tmp_path, router=False) as street:
        street.merge(street_tile(EAST, wall=True), "vehicle-07", quietly=True)
        path = street.path
    with served(path) as page:
        wanted, packed = answers(page), page.get(f"/api/tiles/{EAST.morton}/2.bin").body
    copied = CliRunner().invoke(gnd, ["store", "copy", str(path), url])
    assert copied.exit_code == 0, copied.output
    with served(url, "--allow-changes") as page:
        assert answers(page) == wanted
        bearer = {"Authorization": f"Bearer {page.token}"}
        found = page.get(f"/api/tiles/{EAST.morton}/2.bin", **bearer).body
        assert {name: one.tolist() for name, one in columns_of(found).items()} == {
            name: one.tolist() for name, one in columns_of(packed).items()
        }
        assert url.rpartition("@")[0].rpartition(":")[2] not in str(page.value("/api/map")), "no password is shown"

        with open_store(url, create=False) as store:
            store.put_tiles([street_tile(HERE, wall=False)])
            deadline_s = time.monotonic() + 60
            while page.value("/api/tiles?box=-5,-5,5,5")["tiles"][0]["version"] != 2:
                assert time.monotonic() < deadline_s, "a version that somebody else publishes is not seen"
                time.sleep(0.1)
            (new,) = (one for one in page.value("/api/changes")["changes"] if one["change"] == "new")
            assert page.decide(new["key"], "doubt", "a mirror").status == 200
            newest = store.get("ndt", EAST)
            assert newest is not None
            assert (newest.version, newest.kind) == (3, "rollback")
            assert store.doubted_vehicles("ndt", EAST) == {"vehicle-07"}
