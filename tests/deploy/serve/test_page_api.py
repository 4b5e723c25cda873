"""What the page's server answers is what the Python API gives; what is asked badly is refused by name."""

import json
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from page_testing import EAST, HERE, LiveStreet, ServedPage, columns_of, live_street, served, street_tile
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

import gnd
from gnd.gnd_map.tile import diff
from gnd.tile_store.sqlite_store import SqliteStore


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveStreet]:
    with live_street(tmp_path_factory.mktemp("street")) as opened:
        opened.merge(street_tile(HERE, wall=False))
        opened.merge(street_tile(HERE, wall=False, hump=0.3), "vehicle-08")
        yield opened


@pytest.fixture(scope="module")
def page(street: LiveStreet) -> Iterator[ServedPage]:
    with served(street.path, "--connect", street.endpoint) as opened:
        yield opened


def socket_of(page: ServedPage, **options: object) -> ClientConnection:
    return connect(page.url.replace("http", "ws") + "api/live", open_timeout=30, **options)  # type: ignore[arg-type]


def test_the_map_is_where_and_as_large_as_the_store_says(page: ServedPage, street: LiveStreet) -> None:
    about = page.value("/api/map")
    assert (about["tiles"], about["changed_tiles"], about["layer"]) == (2, 1, "ndt")
    with gnd.Map(street.path) as opened:
        history = opened.history(HERE)
        gaussians = opened.gaussians()
    assert about["first_ms"] == min(history[0].created_ns, history[0].created_ns) // 1_000_000
    assert about["changed_ms"] == history[1].created_ns // 1_000_000
    west, south, east, north = about["extent_m"]
    assert west < 0 < east
    assert south < 0 < north
    assert 40 < east - west < 120
    assert about["ground_m"] == pytest.approx(np.percentile(gaussians.height_m, 10), abs=0.6)


def test_tiles_of_a_box_come_nearest_first_with_all_their_versions(page: ServedPage, street: LiveStreet) -> None:
    told = page.value("/api/tiles?box=-100,-100,100,100")
    assert {one["id"] for one in told["tiles"]} == {HERE.morton, EAST.morton}
    assert told["left_out"] == 0
    assert told["tiles"][0]["place"] == [0.0, 0.0, 0.0]
    (here,) = (one for one in told["tiles"] if one["id"] == HERE.morton)
    with gnd.Map(street.path) as opened:
        assert here["versions"] == [[line.version, line.created_ns // 1_000_000] for line in opened.history(HERE)]
    assert page.value("/api/tiles?box=5000,5000,5100,5100") == {"tiles": [], "left_out": 0}


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_packed_tile_holds_the_gaussians_of_its_version(page: ServedPage, street: LiveStreet, version: int) -> None:
    found = columns_of(page.get(f"/api/tiles/{HERE.morton}/{version}.bin").body)
    with gnd.Map(street.path) as opened:
        gaussians = opened.tile(HERE, version=version).gaussians  # type: ignore[union-attr]
    assert found["voxel"].tolist() == gaussians.voxel_id.tolist()
    x, y, z, w = (found["turn"] / 32767.0).T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    sd_m = found["shape"][:, :3] * 1e-4
    cov = np.einsum("nij,nj,nkj->nik", R, sd_m**2, R)
    np.testing.assert_allclose(cov, gaussians.full_cov(), atol=2e-4)
    assert found["shape"][:, 3].tolist() == np.minimum(gaussians.count, 65_535).tolist()
    grid = gnd.LocalFrame.of_tile(HERE)
    lat, lon, height = grid.geodetic_from_enu(found["mean"].astype(float))
    with gnd.Map(street.path) as opened:
        then = opened.gaussians(HERE, at=opened.history(HERE)[version - 1].created_ns)
    np.testing.assert_allclose(np.degrees(lat), then.lat_deg, atol=1e-9)
    np.testing.assert_allclose(np.degrees(lon), then.lon_deg, atol=1e-9)
    np.testing.assert_allclose(height, then.height_m, atol=1e-3)


def test_each_voxel_says_since_when_and_on_whose_word_it_is_so(page: ServedPage, street: LiveStreet) -> None:
    found = columns_of(page.get(f"/api/tiles/{HERE.morton}/3.bin").body)
    before, after = street_tile(HERE).gaussians, street_tile(HERE, wall=False, hump=0.3).gaussians
    changed = np.isin(after.voxel_id, diff(before, after).put.voxel_id)
    assert 0 < changed.sum() < len(changed)
    assert np.array_equal(found["kind"] == 2, changed)
    assert np.array_equal(found["reports"] == 1, changed)
    with gnd.Map(street.path) as opened:
        published_s = opened.history(HERE)[2].created_ns // 10**9
    assert set(found["since"][changed].tolist()) == {published_s}
    assert set(found["since"][~changed].tolist()) == {1_767_225_600}


@pytest.mark.parametrize(("level", "fewer"), [(1, 3), (2, 8)])
def test_merged_blocks_keep_points_and_spread(page: ServedPage, level: int, fewer: int) -> None:
    fine = columns_of(page.get(f"/api/tiles/{HERE.morton}/1.bin?level=0").body)
    blocks = columns_of(page.get(f"/api/tiles/{HERE.morton}/1.bin?level={level}").body)
    assert fewer * len(blocks["voxel"]) < len(fine["voxel"])
    weights = [one["shape"][:, 3].astype(float) for one in (fine, blocks)]
    assert weights[0].sum() == weights[1].sum()
    means = [weight @ one["mean"] / weight.sum() for weight, one in zip(weights, (fine, blocks), strict=True)]
    np.testing.assert_allclose(means[0], means[1], atol=1e-3)


def test_a_version_may_be_kept_for_ever_and_nothing_else(page: ServedPage) -> None:
    packed = page.get(f"/api/tiles/{HERE.morton}/1.bin", accept_encoding="gzip")
    assert "immutable" in packed.headers["cache-control"]
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.body == page.get(f"/api/tiles/{HERE.morton}/1.bin").body
    for path in ("/api/map", "/api/status", "/api/overview.bin"):
        assert page.get(path).headers["cache-control"] == "no-store"


def test_a_voxel_tells_its_story(page: ServedPage, street: LiveStreet) -> None:
    wall = diff(street_tile(HERE, wall=False).gaussians, street_tile(HERE).gaussians).put.voxel_id
    told = page.value(f"/api/voxel/{HERE.morton}/{wall[0]}")
    assert told["gaussian"] is None
    assert [(step["version"], step["what"]) for step in told["steps"]] == [(1, "surveyed"), (2, "deleted")]
    (report,) = told["steps"][1]["reports"]
    assert (report["vehicle"], report["says"]) == ("vehicle-07", "deleted")
    assert report["rays"] == {"blocked_inside": 7, "blocked_outside": 1, "in_empty": 0, "passed_inside": 3}
    with gnd.Map(street.path) as opened:
        assert report["id"] in opened.store.voxel_provenance("ndt", HERE, 2)[int(wall[0])]
    then = page.value(f"/api/voxel/{HERE.morton}/{wall[0]}?version=1")
    assert (then["gaussian"]["points"], len(then["steps"])) == (400, 1)


def test_the_work_list_names_what_changed_and_who_said_so(page: ServedPage) -> None:
    found = page.value("/api/changes")["changes"]
    assert {"deleted", "modified"} <= {one["change"] for one in found}
    deleted = next(one for one in found if one["change"] == "deleted")
    assert (deleted["shape"], deleted["vehicles"], deleted["voxels"]) == ("wall", 1, 120)
    assert np.hypot(*deleted["at_m"][:2]) < 20


def test_status_history_overview_and_traffic(page: ServedPage, street: LiveStreet) -> None:
    status = page.value("/api/status")
    assert status["queue"]["tiles"] == 0
    assert status["live"] is True
    assert [one["version"] for one in page.value(f"/api/tiles/{HERE.morton}/history")] == [1, 2, 3]
    overview = page.get("/api/overview.bin").body
    assert len(overview) == 16 * 2
    assert sorted(np.frombuffer(overview[16:24], "<u4").tolist()) == [1, 3]
    assert "serve the folder of a run" in page.value("/api/traffic")["problem"]


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/api/tiles/1/1.bin", 404),
        (f"/api/tiles/{HERE.morton}/99.bin", 404),
        (f"/api/tiles/{2**60}/1.bin", 400),
        (f"/api/tiles/{HERE.morton}/1.bin?level=7", 400),
        (f"/api/tiles/{HERE.morton}/1.bin?level={'9' * 5000}", 400),
        ("/api/tiles?box=1,2,3", 400),
        ("/api/tiles?box=nan,0,1,1", 400),
        ("/api/tiles?box=-1e30,-1e30,1e30,1e30", 400),
        ("/api/tiles?box=10,0,0,10", 400),
        ("/api/tiles/x/history", 400),
        ("/api/tiles/5/history", 404),
        (f"/api/voxel/{HERE.morton}/abc", 400),
        (f"/api/voxel/{HERE.morton}/99999999999", 400),
        (f"/api/voxel/{HERE.morton}/1?version=50", 404),
        ("/api/features/ndt", 400),
        ("/api/features/%2e%2e%2fmap.sqlite", 404),
        ("/../../../../etc/passwd", 404),
        ("/..%2f..%2fetc%2fpasswd", 404),
        ("/page.js%00.html", 404),
        ("/map.sqlite", 404),
        ("/api/nothing", 404),
    ],
)
def test_what_there_is_not_is_refused_by_name(page: ServedPage, path: str, status: int) -> None:
    answer = page.get(path)
    assert answer.status == status
    assert b"Traceback" not in answer.body
    if path.startswith("/api/") and status == 400:
        assert answer.value["error"]


def test_every_answer_allows_nothing_from_elsewhere(page: ServedPage) -> None:
    for path in ("/", "/page.js", "/page.css", "/api/map", "/api/none", f"/api/tiles/{HERE.morton}/1.bin"):
        headers = page.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert "server" not in headers
    text = page.get("/").body.decode()
    assert re.findall(r'(?:src|href)="([^"]*)"', text) == ["icon.svg", "page.css", "page.js", "icon.svg"]
    assert "<style" not in text
    assert not re.search(r"<script(?![^>]*src=)", text)


def test_another_name_another_site_and_other_methods_are_refused(page: ServedPage) -> None:
    assert page.get("/api/map", host="evil.example").status == 421
    assert page.get("/api/map", host=f"evil.example:{page.port}").status == 421
    assert page.get("/api/map", host="").status in (400, 421)
    assert page.get("/api/map", host=f"localhost:{page.port}").status == 200
    assert page.get("/api/map", Origin="http://evil.example").status == 403
    assert page.get("/api/map", Origin=f"http://127.0.0.1:{page.port}").status == 200
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        assert page.get("/api/map", method=method).status == 405
    with pytest.raises((InvalidStatus, ConnectionClosed)), socket_of(page, origin="http://evil.example") as socket:
        socket.recv(timeout=10)


def test_what_a_browser_says_is_bounded_and_not_looked_at(page: ServedPage) -> None:
    with socket_of(page) as socket:
        socket.send("{" * 900)
        socket.send(json.dumps({"type": "delete"}))
        assert json.loads(socket.recv(timeout=30))["type"]
        socket.send("x" * 5000)
        with pytest.raises(ConnectionClosed):
            list(socket)
        assert socket.close_code == 1009
    assert page.value("/api/map")["tiles"] == 2


def wait_for(socket: ClientConnection, kind: str, timeout_s: float = 60.0) -> dict[str, object]:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        message: dict[str, object] = json.loads(socket.recv(timeout=timeout_s))
        if message["type"] == kind:
            return message
    raise AssertionError(f"no message of type {kind} within {timeout_s} s")


def test_updates_and_vehicles_are_told_as_they_happen_also_over_a_lost_router(tmp_path: Path) -> None:
    with live_street(tmp_path) as street, served(street.path, "--connect", street.endpoint) as page:
        with socket_of(page) as socket:
            wait_for(socket, "status")
            assert street.merge(street_tile(HERE, wall=False)) == 2
            told = wait_for(socket, "update")
            assert (told["layer"], told["before"], told["version"]) == ("ndt", 1, 2)
            assert told["tile"] == page.value("/api/tiles?box=-5,-5,5,5")["tiles"][0]
            street.tell("vehicle-01", *np.degrees(HERE.centre_rad), health="degraded", odometer_m=10.0)
            (vehicle,) = wait_for(socket, "vehicles")["vehicles"]  # type: ignore[misc]
            assert (vehicle["name"], vehicle["health"]) == ("vehicle-01", "degraded")
            street.stop_router()
            assert street.merge(street_tile(HERE, wall=False, hump=0.2), quietly=True) == 3
            assert wait_for(socket, "update")["version"] == 3
            street.start_router()
            assert street.merge(street_tile(HERE, wall=True), quietly=True) == 4
            assert wait_for(socket, "update")["version"] == 4
        assert page.end(signal.SIGTERM) == 0


def test_a_store_alone_is_followed_and_ctrl_c_ends_it_at_once(tmp_path: Path) -> None:
    with live_street(tmp_path, router=False) as street:
        page = ServedPage(street.path)
        try:
            with socket_of(page) as socket:
                wait_for(socket, "status")
                street.merge(street_tile(HERE, wall=False), quietly=True)
                assert wait_for(socket, "update")["version"] == 2
                begin_s = time.monotonic()
                assert page.end(signal.SIGINT) == 0
                assert time.monotonic() - begin_s < 20
        finally:
            page.end()


def test_a_map_that_begins_empty_lies_where_its_first_tiles_are(tmp_path: Path) -> None:
    path = tmp_path / "empty.sqlite"
    with SqliteStore(path) as store, served(path) as page:
        about = page.value("/api/map")
        assert (about["tiles"], about["key"], about["first_ms"]) == (0, "", 0)
        with socket_of(page) as socket:
            wait_for(socket, "status")
            store.put_tiles([street_tile(HERE), street_tile(EAST)])
            assert wait_for(socket, "update")["before"] == 0
        about = page.value("/api/map")
        assert about["tiles"] == 2
        assert np.allclose(about["origin_deg"], np.degrees(HERE.centre_rad), atol=0.001)
        assert len(page.value("/api/tiles?box=-100,-100,100,100")["tiles"]) == 2
