"""Localisation on simulated streets whose map is partly outdated, and on real recordings, against their references."""

from pathlib import Path

import pytest
from replay import grid_frame_of, map_of, reference_of, replay

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.vehicle_agent.importer import map_track, open_recording, write_drive
from gnd.vehicle_agent.localise import LocalisationError, LocaliserParameters, localisation_error
from gnd.vehicle_agent.localise.parameters import RefineParameters

SEED = 5  # of no street on which anything was tuned


@pytest.fixture(scope="module")
def outdated_map(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(mapping drive before the changes, vehicle's drive after them) of one street."""
    folder, world = tmp_path_factory.mktemp("street"), street(SEED)
    mapping = DriveConfig("mapper", "HDL-32E", state="before", car_share=0.0, errors=PERFECT, cruise_mps=13.0, seed=1)
    vehicle = DriveConfig("vehicle", "VLP-16", state="after", cruise_mps=12.0, seed=2)
    return simulate_drive(world, mapping, folder / "map.mcap"), simulate_drive(world, vehicle, folder / "vehicle.mcap")


@pytest.mark.slow
def test_street_that_has_changed(outdated_map):
    """The paper reaches 0.031 m, 0.0125 m and 0.053° (Table 2); Ford asks for 0.15 m and 0.17°."""
    mapping, vehicle = outdated_map
    run = replay(vehicle, map_of([mapping], grid_frame_of(mapping)))
    assert run.localiser.initialisations == 1
    assert len(run.final) == run.scans - run.localiser.dropped_scans
    assert run.localiser.dropped_scans <= 0.05 * run.scans
    reference = reference_of(vehicle)
    final, online = localisation_error(run.final, reference), localisation_error(run.online, reference)
    assert final.longitudinal_p95_m < 0.05
    assert final.lateral_p95_m < 0.03
    assert final.heading_p95_deg < 0.08
    assert final.longitudinal_max_m < 0.15
    assert final.lateral_max_m < 0.15
    assert online.lateral_p95_m < 0.06
    ratios = [estimate.matching_ratio for estimate in run.final]
    assert min(ratios) < 0.85 < max(ratios)  # it did pass what has changed


def write_halves(kind: str, folder: Path, out: Path) -> Path:
    """Even and odd scans as two drives, both with the LiDAR odometry of all."""
    recording = open_recording(kind, folder)
    track = map_track(recording)
    for half in ("even", "odd"):
        write_drive(recording, track, out / f"{half}.mcap", half, stand_ins=True)
    return out


@pytest.fixture(scope="module")
def radiate(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_halves("radiate", shared_data / "radiate_fog", tmp_path_factory.mktemp("radiate"))


def half_on_half(out: Path, parameters: LocaliserParameters | None = None) -> LocalisationError:
    """Even scans build the map, odd scans drive on it; the error against the LiDAR odometry of both."""
    run = replay(out / "odd.mcap", map_of([out / "even.mcap"], grid_frame_of(out / "odd.mcap")), parameters)
    assert len(run.final) == run.scans
    assert {estimate.health for estimate in run.final} == {"good"}
    return localisation_error(run.final, reference_of(out / "odd.mcap"))


@pytest.mark.slow
def test_kitti_half_on_half(shared_data, tmp_path):
    error = half_on_half(write_halves("kitti", shared_data / "kitti00_start16", tmp_path))
    assert error.longitudinal_p95_m < 0.02
    assert error.lateral_p95_m < 0.02
    assert error.heading_p95_deg < 0.05


@pytest.mark.slow
def test_radiate_in_fog_half_on_half(radiate):
    """Speed and yaw rate are the recording's own, 1 to 2 % and several centimetres a step off."""
    single = LocaliserParameters(refine=RefineParameters(enabled=False))
    error = half_on_half(radiate, single)
    assert error.longitudinal_p95_m < 0.05
    assert error.lateral_p95_m < 0.02
    assert error.heading_p95_deg < 0.1


@pytest.mark.slow
def test_radiate_in_fog_half_on_half_with_submaps(radiate):
    """Submaps are worse there than single scans: where the map ends they slide (docs/decisions/0053)."""
    error = half_on_half(radiate)
    assert error.longitudinal_p95_m < 0.09
    assert error.lateral_p95_m < 0.04
    assert error.heading_p95_deg < 0.1
