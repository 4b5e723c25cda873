"""What the upkeep of a store costs: `python -m studies.store_upkeep` (decision 105)."""

import json
import tempfile
import time
from pathlib import Path

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

REFUSED = 328
REFUSED_BYTES = 1_000_000
BEGINS = 300


def measure(path: Path) -> dict[str, float]:
    """Figures of a store at `path`, which is made."""
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        begin_s = time.perf_counter()
        for number in range(REFUSED):
            store.quarantine(number.to_bytes(4, "big") * (REFUSED_BYTES // 4), "a reason", "a key")
        refused_s = time.perf_counter() - begin_s
        store.put_reports(
            [ReportRow(deterministic_report_id(1, "v"), "ndt", TileId(497353963154), "v", time.time_ns(), b"body")]
        )
        (claim,) = store.claim("shard", 1, 60.0)
        begin_s, begin_cpu_s = time.perf_counter(), time.process_time()
        for _ in range(BEGINS):
            store.begin([claim], 60.0)
        return {
            "refused_mb": REFUSED * REFUSED_BYTES / 1e6,
            "refused_s": refused_s,
            "store_mb": path.stat().st_size / 1e6,
            "begin_ms": 1e3 * (time.perf_counter() - begin_s) / BEGINS,
            "begin_cpu_ms": 1e3 * (time.process_time() - begin_cpu_s) / BEGINS,
        }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder) / "store.sqlite"), indent=1))
