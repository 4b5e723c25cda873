import re
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.utm import geodetic_from_utm, utm_from_geodetic
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importers.apollo import is_apollo, open_apollo, utm_zone
from gnd.vehicle_agent.importers.apollo_map import read_ndt_map
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import Recording


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data / "apollo_ndt"


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    return open_apollo(folder, None)


def test_the_format_is_found_from_the_map_beside_the_scans(folder: Path) -> None:
    assert is_apollo(folder)
    assert format_of(folder) == "apollo"
    assert utm_zone(folder) == (10, False)


def test_the_place_is_that_of_the_poses(folder: Path, recording: Recording) -> None:
    row = np.loadtxt(folder / "pcds" / "poses.txt")[0]
    east, north = utm_from_geodetic(np.radians(recording.anchor.lat_deg), np.radians(recording.anchor.lon_deg), 10)
    np.testing.assert_allclose([east, north, recording.anchor.height_m], row[2:5], atol=1e-4)
    assert str(np.datetime64(int(recording.t_ns[0]), "ns")).startswith("2018-10-11T21:22:14")


def test_the_vehicle_drives_where_it_looks(folder: Path, recording: Recording) -> None:
    """Grid north is 0.6° off true north: attitudes and positions are turned alike."""
    assert recording.track is not None
    step = T_inverse(recording.track.T_dst_vehicle[0]) @ recording.track.T_dst_vehicle[1]
    assert 0.7 < step[0, 3] < 0.9
    assert abs(step[1, 3]) < 0.03
    utm = np.loadtxt(folder / "pcds" / "poses.txt")[:, 2:5]
    length_m = np.linalg.norm(np.diff(utm, axis=0))
    assert np.linalg.norm(step[:3, 3]) == pytest.approx(length_m / 0.9997, rel=1e-4)  # the grid's scale there


def test_scans_lie_on_apollos_own_map(folder: Path, recording: Recording) -> None:
    """The outside oracle: read and turned rightly, most points lie in a cell's flat Gaussian within centimetres."""
    cells = read_ndt_map(folder)
    rows = np.loadtxt(folder / "pcds" / "poses.txt")
    T = open_recording("pcd", folder, recording.anchor).track.T_dst_vehicle[0].copy()  # type: ignore[union-attr]
    T[:3, 3] = rows[0, 2:5]
    points = transform(T, recording.read(0).points_m[::20].astype(np.float64))
    values, vectors = np.linalg.eigh(cells.cov_m2)
    flat = (cells.count >= 20) & (values[:, 0] < 0.005) & (values[:, 1] > 0.02)
    at = {tuple(key): row for row, key in enumerate(_keys(cells.mean_utm_m)) if flat[row]}
    found = [(row, p) for key, p in zip(_keys(points), points, strict=True) if (row := at.get(tuple(key))) is not None]
    off_m = [abs(vectors[row, :, 0] @ (p - cells.mean_utm_m[row])) for row, p in found]
    assert len(off_m) > 0.5 * len(points)
    assert np.median(off_m) < 0.015


def _keys(p_m: np.ndarray) -> list[tuple[int, ...]]:
    """Numbers of cells; Apollo rounds heights towards zero."""
    east, north, up = p_m.T
    return list(zip(*(n.astype(int).tolist() for n in (np.floor(east), np.floor(north), np.trunc(up))), strict=True))


def test_the_map_is_whole(folder: Path) -> None:
    """Its cells hold ten times the points of the two scans: Apollo made it of more of them."""
    cells = read_ndt_map(folder)
    assert len(cells) == 20_584
    assert cells.count.sum() == 1_991_303
    assert np.linalg.eigvalsh(cells.cov_m2[cells.count >= 6]).min() > -1e-3


def test_a_drive_can_be_made_of_it(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "apollo.mcap"
    assert import_recording("auto", folder, out).scans == 2
    lat, lon, _ = read_header(out).anchor.geodetic_from_enu(load_track(out).reference.T_map_vehicle[1, :3, 3])
    expected = geodetic_from_utm(*np.loadtxt(folder / "pcds" / "poses.txt")[1, 2:4], 10)
    np.testing.assert_allclose([lat, lon], expected, atol=1e-10)


def _copy(folder: Path, to: Path) -> Path:
    shutil.copytree(folder, to, copy_function=shutil.copyfile)
    for path in [to, *to.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    return to


def test_damage_is_told(folder: Path, tmp_path: Path) -> None:
    broken = _copy(folder, tmp_path / "broken")
    node = next((broken / "ndt_map" / "map").rglob("00004596"))
    node.write_bytes(node.read_bytes()[:5000])
    with pytest.raises(ImportDriveError, match="no node of an NDT map"):
        read_ndt_map(broken)
    endless = zlib.compress(struct.pack("<2I", 2**32 - 1, 0))  # rows without a column: nothing in them ends the loop
    node.write_bytes(struct.pack("<5I", 0, 10, 1, 4596, len(endless)) + endless)
    with pytest.raises(ImportDriveError, match="4294967295 rows of 0 columns in 8 bytes"):
        read_ndt_map(broken)
    config = broken / "ndt_map" / "config.xml"
    config.write_text(re.sub(r"<x>\d+</x>", f"<x>{'9' * 400}</x>", config.read_text()))
    with pytest.raises(ImportDriveError, match=r"cells of \[inf, .*at most \(65536.0, "):
        read_ndt_map(broken)
    (broken / "pcds" / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(ImportDriveError, match="a line a scan of 9"):
        open_apollo(broken, None)
    (broken / "ndt_map" / "map" / "000" / "north" / "11").mkdir()
    with pytest.raises(ImportDriveError, match="2 UTM zones"):
        open_apollo(broken, None)
