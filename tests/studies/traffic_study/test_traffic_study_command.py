"""`gnd reproduce traffic` on a short street."""

import json
from pathlib import Path
from typing import Any

import pytest
from traffic_world import result_of_study, study

from studies.traffic_study.figures import spread
from studies.traffic_study.summary import TARGETS, targets_of
from studies.traffic_study.uploads import PACKET_BYTES, PARTS, raw_bytes

Finished = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Folder and JSON of a finished study."""
    out = tmp_path_factory.mktemp("traffic") / "run"
    return out, result_of_study(out)


@pytest.mark.slow
def test_every_byte_of_an_upload_has_its_part(finished: Finished) -> None:
    drives = finished[1]["drives"]
    assert len(drives) == 3
    for drive in drives:
        assert set(drive["parts"]) == set(PARTS)
        assert sum(drive["parts"].values()) - drive["parts"]["acks"] == drive["bytes"]
        assert drive["changed"] == sum(drive["classes"].values()) > 0
        assert drive["parts"]["whole"] == 0
        assert drive["parts"]["flags"] > 0
        assert drive["wanted"] <= drive["classes"]["new"] + drive["classes"]["modified"]
    assert finished[1]["upload"]["single"]["gnd"]["bytes"] == drives[0]["bytes"]
    assert finished[1]["upload"]["fleet"]["gnd"]["bytes"] == sum(drive["bytes"] for drive in drives)
    assert finished[1]["upload"]["single"]["gnd_float"]["bytes"] > 5 * drives[0]["bytes"]


@pytest.mark.slow
def test_rates_stand_beside_their_densities(finished: Finished) -> None:
    up, down = finished[1]["upload"], finished[1]["download"]
    for stage in ("first", "flags_first", "steady"):
        assert up["changed_per_km"][stage] > 0
        assert up["kB_per_km"][stage] < up["wire_kB_per_km"][stage]
        parts = sum(v for part, v in up["parts_bytes_per_km"][stage].items() if part != "acks")
        assert parts == pytest.approx(1e3 * up["kB_per_km"][stage], rel=0.01)
    assert down["voxels_per_km"] == pytest.approx(down["voxels"] / finished[1]["km"], rel=0.01)
    assert down["gnd"]["bytes"] / down["voxels"] < 8.0
    assert down["gnd"]["bytes"] < down["gnd_float"]["bytes"] < down["gnd_protobuf"]["bytes"] < down["pcd"]["bytes"]
    assert down["pcd"]["bytes"] == pytest.approx(12 * down["points"], rel=0.01)
    assert down["return_bytes_per_tile"] < down["gnd"]["bytes"] / down["tiles"]
    assert down["along"]["gnd"][-1][2] == down["gnd"]["bytes"]


@pytest.mark.slow
def test_the_codecs_grow_coarser_and_smaller(finished: Finished) -> None:
    codec = finished[1]["codec"]
    sizes = [one["bytes_per_voxel"] for one in (codec["archive"], codec, codec["compact"])]
    assert sizes == sorted(sizes, reverse=True)
    assert codec["archive"]["kl_median"] < codec["compact"]["kl_median"]
    assert 0.0 < codec["pose_shift_cm_median"] < 1.0


@pytest.mark.slow
def test_the_map_is_scored_as_it_travelled_and_in_floats(finished: Finished) -> None:
    f1 = finished[1]["f1"]
    assert f1["drives"] == 2
    assert min(f1["codec"], f1["float"]) > f1["stale"]


@pytest.mark.slow
def test_the_second_start_drives_no_more_and_shows_the_same(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a drive or a cloud was made again")

    monkeypatch.setattr("studies.simulation.study.run_vehicle", never)
    monkeypatch.setattr("studies.traffic_study.clouds.street_cloud", never)
    shown = study(finished[0], "--json", str(tmp_path / "out.json"))
    assert shown.exit_code == 0, f"{shown.output}{shown.exception!r}"
    for text in ("download along", "voxels", "changes a km", "upload, steady state", "targets"):
        assert text in shown.stdout
    again = json.loads((tmp_path / "out.json").read_text())
    same = set(again) - {"codec", "targets", "runtime_s"}  # which hold times
    assert {name: again[name] for name in same} == {name: finished[1][name] for name in same}
    for name in ("download.png", "upload_fleet.png"):
        assert (finished[0] / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--street", "moon"], "usual, rebuilt"),
        (["--drives", "0"], "drives"),
        (["--length", "50"], "100 … 1000"),
        (["--edits", "2"], "edit_share"),
        (["--sensor", "sonar"], "sonar"),
        (["--poses", "guessed"], "guessed"),
        (["--parking", "1.5"], "parking"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(tmp_path: Path, options: list[str], message: str) -> None:
    ran = study(tmp_path / "out", *options)
    assert ran.exit_code != 0
    assert message in f"{ran.output}{ran.exception}"
    assert not (tmp_path / "out").exists()


def test_a_vlp16_measures_as_much_as_its_packets_hold() -> None:
    assert raw_bytes("vlp16", 100) == pytest.approx(754 * 10 * PACKET_BYTES, rel=0.02)
    assert raw_bytes("hdl32e", 100) > 1.8 * raw_bytes("vlp16", 100)


def test_targets_are_judged_by_their_own_direction() -> None:
    row = {"bytes": 100}
    found: dict[str, Any] = {
        "download": {"gnd": row, "pcd": {"bytes": 7000}, "laz": {"bytes": None}, "return_bytes_per_tile": 80.0},
        "f1": {"float": 99.0, "codec": 98.9},
        "upload": {"kB_per_km": {"first": 2.0, "flags_first": 1.6, "steady": 1.2}},
    }
    rows = targets_of(found)
    assert rows["download, PCD to GND"] | {"value": 70.0, "met": True, "aim_met": False} == rows["download, PCD to GND"]
    assert "download, LAZ to GND" not in rows
    assert not rows["upload, steady state"]["met"]
    assert rows["upload, first sighting"]["aim_met"]
    assert rows["F1 lost by the codec"]["value"] == pytest.approx(0.1)
    assert rows["F1 lost by the codec"]["met"]
    assert set(rows) < {target.name for target in TARGETS}


def test_notes_keep_their_distance_and_their_order() -> None:
    found = spread([0.5, 0.51, 0.1, 0.52], 0.1)
    assert found == pytest.approx([0.5, 0.6, 0.1, 0.7])
