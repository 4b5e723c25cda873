"""A store of the release before vehicles were heard by kind of statement: its versions are computed as they were made.

`data/store_before_hearing.sqlite.xz` holds two tiles of `gnd fleet` at 1e8a5c0c (schema 12), eight simulated vehicles.
"""

import lzma
from pathlib import Path

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.tile_store.sqlite_store import SqliteStore

OLD = Path(__file__).parent / "data" / "store_before_hearing.sqlite.xz"


def test_versions_made_by_older_rules_are_recomputed_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "map.sqlite"
    path.write_bytes(lzma.decompress(OLD.read_bytes()))
    with SqliteStore(path) as store:
        verifier = Verifier(store, ShardConfig("verifier", path))
        found = [
            verifier.version("ndt", head.tile, one.version).status
            for head in store.heads("ndt")
            for one in store.history("ndt", head.tile)
        ]
    assert found.count("given") == 2
    assert found.count("same") == len(found) - 2 >= 10
