"""What the tests of the Python API share: small tiles, a cloud that publishes, programs in processes of their own."""

import os
import queue
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.cloud_merger.announce import encoded, update_of
from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import Feature, FeatureTile, hit
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.tile_store.sqlite_store import SqliteStore

ROOT = Path(__file__).resolve().parents[2]
HERE = TileId.from_path("13033/03021/23031/22102")
EAST = TileId.from_path("13033/03021/23031/22103")
FAR = TileId.from_path("03000/00000/00000/00000")


def gaussian_tile(tile: TileId, *voxels: int) -> Tile:
    """A tile as maps hold it: on the lattice, so that the range coder writes it."""
    ids = np.unique(np.array(voxels, np.int32))
    n = len(ids)
    mean_m = np.repeat((ids % 41).astype(np.float32)[:, None] / 100, 3, axis=1)
    cov_m2 = np.tile(np.array([0.04, 0.01, 0, 0.03, 0, 0.001], np.float32), (n, 1))
    count = np.full(n, 100, np.int32)
    return Tile(tile, 0, snap(Gaussians(ids, count, count // 4, mean_m, cov_m2), LATTICES["standard"]))


def sign_tile(tile: TileId, *ids: int) -> FeatureTile:
    cov_m2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
    at = np.array([[1.0, 2.0, 30.0]])
    return FeatureTile.of(tile, 1, [Feature(number, "traffic_sign", at, cov_m2, hit(0.9)) for number in ids])


@dataclass
class Cloud:
    """A router and a tile server over a store, to which versions are published as a merger does."""

    endpoint: str
    store: SqliteStore
    bus: Bus

    def publish(self, tile: AnyTile, layer: str = "ndt", *, quietly: bool = False) -> int:
        """Put the next version of a tile, and its notice on the bus unless `quietly`; the version."""
        (result,) = self.store.put_tiles([tile], layer=layer)
        new, old = (self.store.get(layer, tile.tile_id, n) for n in (result.version, result.version - 1))
        assert new is not None
        if not quietly:
            self.bus.publish(update_key(layer, tile.tile_id), encoded(update_of(new, old)), kind="update")
        return result.version


class Program:
    """A Python program in a process of its own; its output line by line."""

    def __init__(self, arguments: Sequence[str], folder: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "PYTHONUNBUFFERED": "1"},
        )
        self.lines: list[str] = []
        self._new: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stdout or ():
            self.lines.append(line.rstrip("\n"))
            self._new.put(self.lines[-1])

    def line(self, start: str, timeout_s: float = 60.0) -> str:
        """The next line that begins so."""
        while True:
            try:
                line = self._new.get(timeout=timeout_s)
            except queue.Empty:
                raise AssertionError(f"no line {start!r} within {timeout_s} s: {self.lines}") from None
            if line.startswith(start):
                return line

    def end(self) -> int:
        code = self.process.wait(60)
        self._reader.join(10)
        return code
