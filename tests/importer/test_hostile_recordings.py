"""Recordings that somebody else has made: names that lead elsewhere, and files that unpack to more than a disk has."""

import json
import lzma
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import zstandard
from bag_testing import SECOND, cloud, write_bag
from pyarrow import feather
from rosbags.rosbag2 import CompressionMode
from test_format_samples import nuscenes

from gnd.fleet_sim import truth
from gnd.fleet_sim.errors import TruthError
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.argoverse_logs import _columns
from gnd.vehicle_agent.importers.feather_header import MAX_BYTES, read_feather
from gnd.vehicle_agent.importers.files import read_file
from gnd.vehicle_agent.importers.ros import bounds
from studies.benchmark.errors import BenchmarkError
from studies.benchmark.kit.score import SubmissionError, read_worlds
from studies.benchmark.run import worlds_of

POINTS = np.zeros(3, [(axis, "<f4") for axis in "xyz"])


def named(root: Path, name: object) -> None:
    """The first sweep of a data set of nuScenes is said to lie elsewhere."""
    table = root / "v1.0-mini" / "sample_data.json"
    rows = json.loads(table.read_text())
    table.write_text(json.dumps([{**rows[0], "filename": name}, *rows[1:]]))


def test_nuscenes_that_names_files_outside_of_its_folder(tmp_path):
    root, beside = nuscenes(tmp_path / "nuscenes"), tmp_path / "secret.pcd.bin"
    beside.write_bytes(np.zeros((500, 5), np.float32).tobytes())
    (root / "sweeps" / "link.pcd.bin").symlink_to(beside)
    (root / "sweeps" / "up").symlink_to("../..")
    elsewhere = ("../secret.pcd.bin", "../../etc/passwd", "sweeps/../../secret.pcd.bin", str(beside), "/etc/passwd",
                 "sweeps/link.pcd.bin", "sweeps/up/secret.pcd.bin", "../not_there.bin")  # fmt: skip
    for name in elsewhere:
        named(root, name)
        with pytest.raises(ImportDriveError, match="which lies outside of") as refused:
            open_recording("auto", root)
        assert repr(name) in str(refused.value)
        assert "sample_data.json" in str(refused.value)
    for name in ("", "a\0b", 7, None, ["sweeps"]):
        named(root, name)
        with pytest.raises(ImportDriveError, match="is no name of a file"):
            open_recording("auto", root)
    named(root, "sweeps/../sweeps/not_there.bin")  # inside, and not there: left out as ever
    assert len(open_recording("auto", root)) == 7
    (tmp_path / "link").symlink_to(root)  # the folder itself may be one
    assert len(open_recording("auto", tmp_path / "link")) == 7


def packed_bag(folder: Path, *, said: bool, size: int) -> Path:
    """A bag that is packed as a whole, its file replaced by zeros without end."""
    bag = write_bag(folder, [("/points", SECOND, cloud(POINTS, SECOND))], "sqlite3", CompressionMode.FILE)
    (path,) = bag.glob("*.zstd")
    compressor, plain = zstandard.ZstdCompressor(), bytes(1 << 24)
    with path.open("wb") as file, compressor.stream_writer(file, size=size if said else -1) as out:
        for _ in range(size >> 24):
            out.write(plain)
    return bag


def test_a_bag_packed_as_a_whole_that_unpacks_to_more_than_it_may(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "unpacked"))
    (tmp_path / "unpacked").mkdir()
    for said, words in ((True, "says that it unpacks to 4294967296"), (False, "unpacks to more than [0-9]+")):
        bag = packed_bag(tmp_path / f"said-{said}", said=said, size=1 << (32 if said else 29))
        before = shutil.disk_usage(tmp_path).free
        with pytest.raises(ImportDriveError, match=rf"packed bytes: {words}.* bytes, at most \d+ are"):
            open_recording("ros", bag)
        assert not list((tmp_path / "unpacked").iterdir())
        assert before - shutil.disk_usage(tmp_path).free < 1 << 27
    bag = packed_bag(tmp_path / "disk", said=False, size=1 << 27)  # little, but the disk is full
    monkeypatch.setattr(bounds, "KEPT_FREE", 1.0)
    with pytest.raises(ImportDriveError, match=r"unpacks to more than \d+ bytes, \d+ are free in .*unpacked \(TMPDIR"):
        open_recording("ros", bag)
    (path,) = bag.glob("*.zstd")
    path.write_bytes(b"no zstd")
    with pytest.raises(ImportDriveError, match="no Zstandard"):
        open_recording("ros", bag)


def test_a_bag_names_no_file_outside_of_its_folder(tmp_path):
    write_bag(tmp_path / "secret", [("/points", SECOND + k, cloud(POINTS, SECOND + k)) for k in range(3)], "sqlite3")
    bag = write_bag(tmp_path / "bag", [("/points", SECOND, cloud(POINTS, SECOND))], "sqlite3")
    (inside,) = bag.glob("*.db3")
    said = (bag / "metadata.yaml").read_text()
    inside.unlink()
    for name in ("../secret/secret.db3", str(tmp_path / "secret" / "secret.db3"), "..", "."):
        (bag / "metadata.yaml").write_text(said.replace(inside.name, name))
        with pytest.raises(ImportDriveError, match="no readable bag"):
            open_recording("ros", bag)


def test_tables_of_arrow_that_unpack_to_more_than_a_sweep(tmp_path):
    path, n = tmp_path / "a.feather", 1 << 25
    for packed in ("zstd", "lz4"):
        feather.write_feather(pa.table({"x": np.zeros(n)}), path, compression=packed, chunksize=n)
        assert path.stat().st_size < MAX_BYTES // 100
        with pytest.raises(ImportDriveError, match=f"unpack to {8 * n} bytes; a table has at most {MAX_BYTES}"):
            _columns(path, ("x",))
    few = pa.table({"x": np.arange(1000.0), "name": pa.array(["a"] * 1000).dictionary_encode()})
    for packed in ("zstd", "lz4", "uncompressed"):
        feather.write_feather(few, path, compression=packed)
        np.testing.assert_array_equal(_columns(path, ("x", "name"))["x"], np.arange(1000.0))
    data = path.read_bytes()
    for end in range(0, len(data), 101):
        path.write_bytes(data[:end] + data[-6:])
        with pytest.raises(ImportDriveError):
            read_feather(path)


def test_other_files_that_never_end_or_unpack_without_bound(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.bin")
    (tmp_path / "zero.bin").symlink_to("/dev/zero")
    for name in ("pipe.bin", "zero.bin"):
        with pytest.raises(ImportDriveError, match="is no regular file"):
            read_file(tmp_path / name)
    filters = [{"id": lzma.FILTER_LZMA2, "dict_size": 1 << 29, "mode": lzma.MODE_FAST, "mf": lzma.MF_HC3}]
    (tmp_path / "a.bin.xz").write_bytes(lzma.compress(b"few", filters=filters))
    with pytest.raises(ImportDriveError, match="Memory usage limit"):
        read_file(tmp_path / "a.bin.xz")
    np.savez_compressed(tmp_path / "truth.npz", head=np.zeros(10**7, np.uint8))
    monkeypatch.setattr(truth, "MAX_BYTES", 10**7)
    with pytest.raises(TruthError, match="arrays that unpack to 10000128 bytes, at most 10000000 are read"):
        truth.read_truth(tmp_path / "truth.npz")


def test_worlds_of_a_benchmark_that_lie_outside_of_it(tmp_path):
    head = {"format": "gnd.benchmark", "version": 1, "finished": True}
    for name, vehicle in (("../up", "a"), ("/etc", "a"), ("w", "../../a"), ("w", ".."), ("", "a"), ("a\0", "a")):
        said = head | {"worlds": [{"name": name, "vehicles": [vehicle]}]}
        (tmp_path / "benchmark.json").write_text(json.dumps(said))
        with pytest.raises(SubmissionError, match="is no name of a world or a vehicle"):
            read_worlds(tmp_path)
        with pytest.raises(BenchmarkError, match="is no name of a world or a vehicle"):
            worlds_of(tmp_path, said)
    assert list(worlds_of(tmp_path, {"worlds": [{"name": "town-1", "vehicles": ["vehicle-01.b"]}]})) == ["town-1"]
