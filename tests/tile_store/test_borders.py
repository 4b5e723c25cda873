"""A report about features near the border of a district that another store owns: neither half is lost."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from store_helpers import EAGER, FAR, TILE, report

from gnd.schemas.keys import change_key
from gnd.tile_store.borders import carry
from gnd.tile_store.copying import district as moving
from gnd.tile_store.location import open_store
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.uploads import Settled, Upload

pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
Places = tuple[str, str]


@pytest.fixture(params=["to postgresql", "from postgresql"])
def places(request: pytest.FixtureRequest, new_database: Callable[[], str], tmp_path: Path) -> Places:
    """West owns all but the district of FAR, which east owns."""
    file, database = f"sqlite:{tmp_path}/a.db", new_database()
    west, east = (file, database) if request.param == "to postgresql" else (database, file)
    open_store(west, EAGER).close()
    called("create", east, "east")
    called("move", FAR.district.path, "--from", west, "--to", east)
    return west, east


@pytest.fixture(autouse=True)
def nobody_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moving, "NOTICED_S", 0.0)


def called(*words: str) -> dict[str, object]:
    done = CliRunner().invoke(regions, [*words, "--json"])
    assert done.exit_code == 0, done.output + repr(done.exception)
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def settle(store: SqlStore, number: int, *, is_late: bool = False) -> bool:
    """A report about signs on both sides of a border, as a shard settles it."""
    both = tuple(report(number, tile, layer="signs") for tile in (TILE, FAR))
    key = change_key("signs", TILE.district)
    store.put_upload(Upload(key, b"%d" % number, both[0].report_id, "v1", "features", 1), "m")
    (claim,) = store.claim_uploads("m", 8, 60.0)
    if is_late:
        store.release("m")
        assert store.claim_uploads("other", 8, 60.0)
    return store.settle_upload(Settled(claim, "released", both))


def test_each_half_comes_to_its_store_once(places: Places) -> None:
    with open_store(places[0], EAGER) as west, open_store(places[1], EAGER) as east:
        assert settle(west, 1)
        assert [row.tile for row in west.reports("signs")] == [TILE]
        assert list(east.reports("signs")) == []
        (kept,) = west.border_rows(9)
        assert (kept.tile, kept.report_id) == (FAR, report(1).report_id)
        assert carry([west, east]) == 1
        east.put_reports([kept])  # carried twice: whoever carried it was killed before it was forgotten
        assert [row.tile for row in east.reports("signs")] == [FAR]
        assert east.in_play("signs", FAR).seq == 1
        assert carry([west, east]) == 0


def test_who_has_lost_the_lease_keeps_nothing(places: Places) -> None:
    with open_store(places[0], EAGER) as west:
        assert not settle(west, 1, is_late=True)
        assert west.border_rows(9) == []


def test_what_waits_is_shown_and_carried_by_the_command(places: Places) -> None:
    with open_store(places[0], EAGER) as west:
        settle(west, 1)
        settle(west, 2)
    stores = called("list", *places)["stores"]
    assert [one["rows_to_carry"] for one in stores] == [2, 0]  # type: ignore[attr-defined]
    alone = CliRunner().invoke(regions, ["relay", places[0], "--once"])
    assert "none of these stores owns" in alone.output
    done = CliRunner().invoke(regions, ["relay", *places, "--once"])
    assert done.exit_code == 0, done.output
    assert "nothing waits" in done.output
    with open_store(places[1], EAGER) as east:
        assert len(list(east.reports("signs"))) == 2


def test_a_store_that_owns_both_sides_keeps_both(tmp_path: Path) -> None:
    with open_store(tmp_path / "a.db", EAGER) as store:
        settle(store, 1)
        assert {row.tile for row in store.reports("signs")} == {TILE, FAR}
        assert store.border_rows(9) == []
