"""Stores of releases with other rules: their versions are computed as they were made.

`data/store_before_hearing.sqlite.xz` holds two tiles of `gnd fleet` at 1e8a5c0c (schema 12), eight simulated vehicles,
before vehicles were heard by kind of statement. `data/store_with_counters.sqlite.xz` is of 5082e1fc (schema 16), which
had no switch for what several met: two vehicles have published thirty voxels by it, and others are remembered.
"""

import lzma
from pathlib import Path

import pytest
from merger_world import BALL, change_of, report_of

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.statements import is_met
from gnd.cloud_merger.stored import Bases
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

DATA = Path(__file__).parent / "data"


def unpacked(name: str, folder: Path) -> Path:
    path = folder / "map.sqlite"
    path.write_bytes(lzma.decompress((DATA / f"{name}.sqlite.xz").read_bytes()))
    return path


@pytest.mark.parametrize(("name", "tiles", "least"), [("store_before_hearing", 2, 10), ("store_with_counters", 1, 1)])
def test_versions_made_by_older_rules_are_recomputed_to_the_bit(
    tmp_path: Path, name: str, tiles: int, least: int
) -> None:
    path = unpacked(name, tmp_path)
    with SqliteStore(path) as store:
        verifier = Verifier(store, ShardConfig("verifier", path))
        found = [
            verifier.version("ndt", head.tile, one.version).status
            for head in store.heads("ndt")
            for one in store.history("ndt", head.tile)
        ]
    assert found.count("given") == tiles
    assert found.count("same") == len(found) - tiles >= least


def test_a_store_of_before_the_switch_goes_on_without_what_several_met(tmp_path: Path) -> None:
    """What closed windows have published stays and what is remembered of it votes no more; every version verifies."""
    path = unpacked("store_with_counters", tmp_path)
    config = ShardConfig("one", path)
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        (head,) = [store.get("ndt", one.tile) for one in store.heads("ndt")]
        assert head is not None
        held = head.decode_gaussians().gaussians
        assert set(range(20, 50)) <= set(held.voxel_id.tolist())
        journal = store.in_play("ndt", head.tile)
        assert is_met(Bases(store).state(head.tile, journal).memory.claims).sum() == 20
        seen = sorted({*held.voxel_id.tolist(), *range(60, 70), 80, 81})
        for number in range(900, 904):
            change = change_of(held, seen, {80: BALL, 81: BALL}, version=head.version)
            store.put_reports(rows_of(report_of(number, change), 1_900_000_000_000_000_000 + number * 10**13))
            worker = Worker(store, config)
            while claims := store.claim("one", 4, 30.0):
                store.publish(worker.merge(claims))
        state = Bases(store).state(head.tile, store.in_play("ndt", head.tile))
        assert not is_met(state.memory.claims).any()
        now = store.get("ndt", head.tile)
        assert now is not None
        assert not set(range(60, 70)) & set(now.decode_gaussians().gaussians.voxel_id.tolist())
        statuses = [one.status for one in Verifier(store, config).history("ndt", head.tile)]
        assert statuses.count("given") == 1
        assert set(statuses) == {"given", "same"}
