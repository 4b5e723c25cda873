"""`gnd map align` of a Lanelet2 map and a drive through the same simulated street."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.deploy.map_cli import map_group
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.shapes import Post
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_align.candidates import about
from gnd.vehicle_agent.map_align.move import moved_drive
from gnd.vehicle_agent.map_align.posts import features_of, posts_of_cloud, posts_of_features
from gnd.vehicle_agent.map_align.sources import AlignError

TYPES = {"lamp": "street_lamp", "sign": "traffic_sign"}


def furniture(world: World) -> tuple[F64, list[str]]:
    """(N, 3) lamps and signs of a street in the map frame, and their types in OSM."""
    found = [
        ((shape.x_m, shape.y_m, 0.0), TYPES[thing.kind])
        for thing in world.in_state("before")
        for shape in thing.shapes
        if isinstance(shape, Post) and thing.kind in TYPES
    ]
    return world.map_of_street(np.array([place for place, _ in found])), [kind for _, kind in found]


def write_osm(path: Path, frame: LocalFrame, places: F64, types: list[str]) -> Path:
    lat, lon, _ = (np.degrees(one) for one in frame.geodetic_from_enu(places))
    nodes = [
        f'<node id="{k + 1}" lat="{a:.9f}" lon="{o:.9f}"><tag k="type" v="{kind}"/></node>'
        for k, (a, o, kind) in enumerate(zip(lat, lon, types, strict=True))
    ]
    path.write_text(f'<?xml version="1.0"?>\n<osm version="0.6">\n{chr(10).join(nodes)}\n</osm>\n')
    return path


def align(*arguments: object) -> tuple[int, Any]:
    result = CliRunner().invoke(map_group, ["align", *map(str, arguments), "--json"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, json.loads(result.stdout)


@pytest.mark.slow
def test_a_drive_is_laid_on_a_lanelet2_map_and_wrong_maps_are_refused(tmp_path: Path) -> None:
    world, first = street(1003, StreetOptions(length_m=100.0)), tmp_path / "a.mcap"
    simulate_drive(world, DriveConfig("car", "VLP-16", "before", seed=1, cruise_mps=15.0, errors=PERFECT), first)
    frame, (places, types) = read_header(first).anchor, furniture(world)
    hd_map = write_osm(tmp_path / "hd.osm", frame, places, types)
    with SqliteStore(tmp_path / "a.sqlite") as store:
        build_map([first], store)

    status, values = align(hd_map, tmp_path / "a.sqlite")
    assert (status, values["fits"]) == (0, True), values["reasons"]
    assert np.hypot(*values["shift_m"].values()) < 0.06
    assert abs(values["heading_deg"]) < 0.1

    T, away = about(places.mean(axis=0), np.radians(1.5)), tmp_path / "away.mcap"
    T[:2, 3] += 3.0, -2.0
    moved_drive(first, away, frame, T, "moved by a test")
    back = tmp_path / "back.mcap"
    status, values = align(hd_map, away, "--out", back)
    assert (status, values["written"]) == (0, str(back)), values["reasons"]
    truth, found = load_track(first).reference.T_map_vehicle, load_track(back).reference.T_map_vehicle
    assert np.linalg.norm((found - truth)[:, :3, 3], axis=1).max() < 0.12
    assert "moved onto hd.osm by gnd map align" in read_header(back).source

    refused, middle = tmp_path / "refused.sqlite", places.mean(axis=0)
    for name, change in (("mirrored", [1.0, -1.0, 1.0]), ("feet", [1 / 0.3048] * 3), ("larger", [1.006, 1.006, 1.0])):
        wrong = write_osm(tmp_path / f"{name}.osm", frame, middle + (places - middle) * change, types)
        status, values = align(wrong, tmp_path / "a.sqlite", "--out", refused)
        assert (status, values["written"]) == (1, None), name
        assert values["reasons"]
    other = street(1005, StreetOptions(length_m=100.0))
    status, values = align(tmp_path / "a.sqlite", write_osm(tmp_path / "o.osm", frame, *furniture(other)))
    assert status == 1, values
    assert not refused.exists()


def test_what_cannot_be_done_with_hd_maps_is_refused(tmp_path: Path) -> None:
    frame = LocalFrame(0.85, 0.14, 0.0)
    places = np.array([[0.0, 0.0, 0.0], [9.0, 1.0, 0.0], [9.3, 1.0, 0.0]])
    hd_map = write_osm(tmp_path / "a.osm", frame, places, ["pole", "traffic_sign", "traffic_light"])
    posts = posts_of_features(features_of(hd_map), frame)
    np.testing.assert_allclose(posts[np.argsort(posts[:, 0])], [[0.0, 0.0], [9.15, 1.0]], atol=1e-3)
    missing = tmp_path / "missing.sqlite"
    for arguments, says in (
        ([hd_map, hd_map], "are both HD maps"),
        ([missing, hd_map, "--out", tmp_path / "b.osm"], "name it first"),
        ([hd_map, missing, "--picture", tmp_path / "b.png"], "of an HD map it draws nothing"),
        ([hd_map, missing], "cannot be read"),
    ):
        result = CliRunner().invoke(map_group, ["align", *map(str, arguments)])
        assert isinstance(result.exception, AlignError), result.exception
        assert says in str(result.exception)


def test_no_posts_in_an_empty_cloud() -> None:
    from gnd.vehicle_agent.map_align.cloud import cloud_of_tiles

    assert posts_of_cloud(cloud_of_tiles([], LocalFrame(0.85, 0.14, 0.0))).shape == (0, 2)
