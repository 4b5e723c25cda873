"""A message that is about several tiles is booked by its shares, and counts once."""

from pathlib import Path

import pytest

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger import Ledger, LedgerLine, Share
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.gnd_map.tile_id import TileId

TILE = TileId.from_path("13033/03021/23031/22102")
SHARES = (Share("tile", 30), Share("tile", 3000, TILE), Share("delta", 120, "13033/03021/23031/22103"))


def test_shares_add_up_and_are_one_message(tmp_path: Path) -> None:
    ledger = Ledger("a", tmp_path / "a.jsonl")
    ledger.record_shares("down", SHARES)
    ledger.record("down", "tile", 7, TILE)
    assert ledger.totals() == (LedgerLine("delta", "down", 0, 120), LedgerLine("tile", "down", 2, 3037))
    assert ledger.by_tile() == {TILE.path: (1, 3007), "13033/03021/23031/22103": (0, 120)}
    assert read_ledger(tmp_path / "a.jsonl").lines() == ledger.totals()


def test_a_share_of_unknown_kind_is_refused() -> None:
    with pytest.raises(LedgerError, match="no such ledger line: down gossip"):
        Ledger("a").record_shares("down", (Share("gossip", 1),))
