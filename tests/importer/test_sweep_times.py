"""Times of points that were forgotten are found again, and only where they are true."""

import dataclasses

import numpy as np
import pytest
from sweep_testing import drive_of, freed_of_motion, mirrored, recording_of, ring_by_ring, scans_of, without_times

from gnd.schemas.drive import Scan
from gnd.vehicle_agent.importers.deskewing import share_by_azimuth, with_times
from gnd.vehicle_agent.importers.firing_order import firing_share
from gnd.vehicle_agent.importers.plane_thickness import compared, thickness_of
from gnd.vehicle_agent.importers.sweep_times import BINS, AzimuthTimes, FoundSweep, fit_sweep, middle_of_bins_rad

SWEEP_NS = 100_000_000


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return drive_of(tmp_path_factory.mktemp("sweeps") / "drive.mcap", scans=72)


def errors_ms(found, path, change):
    """What is wrong with the times of a recording's points, each against the point of the drive that it is."""
    wrong = []
    for i, scan in enumerate(scans_of(path)):
        truth = change(scan)
        key = {point.tobytes(): offset for point, offset in zip(truth.points_m, scan.t_offset_ns, strict=True)}
        raw = found.read(i)
        wrong += [
            (raw.t_ns + int(o) - scan.t_ns - int(key[p.tobytes()])) * 1e-6
            for p, o in zip(raw.points_m[::50], raw.t_offset_ns[::50], strict=True)
        ]
    return np.array(wrong)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
def test_times_from_azimuths_are_those_that_were_forgotten(drive, turned):
    """Ring by ring, as KITTI's files are; a sensor that turns the other way is found to do so."""

    def other(scan: Scan) -> Scan:
        return mirrored(scan) if turned else scan

    found, verdict = with_times(recording_of(drive, lambda scan: ring_by_ring(other(scan))))
    print(verdict.note)
    assert verdict.deskew == found.deskew == "reconstructed"
    assert ("counter-clockwise" in verdict.note) == turned
    wrong = errors_ms(found, drive, other)
    assert np.abs(wrong).max() < 4.0  # the beginning is found to 5°, 1.4 ms; no point is a sweep off
    kept = sum(len(found.read(i)) for i in range(len(found))) / sum(len(scan) for scan in scans_of(drive))
    assert 0.93 < kept < 0.99  # those within 8° of the beginning may be of its end


def test_times_from_the_firing_order_are_those_that_were_forgotten(drive):
    for scan in scans_of(drive)[::10]:
        share = firing_share(scan.points_m)
        np.testing.assert_allclose(share * SWEEP_NS, scan.t_offset_ns.astype(np.float64), atol=0.012 * SWEEP_NS)
        assert firing_share(ring_by_ring(scan).points_m) is None
        rng = np.random.default_rng(0)
        assert firing_share(scan.points_m[rng.permutation(len(scan))]) is None


@pytest.mark.slow
def test_scans_in_firing_order_take_their_times_from_it(drive):
    found, verdict = with_times(recording_of(drive, without_times))
    assert verdict.deskew == "reconstructed"
    assert "firing order, clockwise" in verdict.note
    assert np.abs(errors_ms(found, drive, lambda scan: scan)).max() < 2.0


@pytest.mark.slow
def test_sweeps_that_were_freed_of_motion_stay_as_they_are(drive):
    recording = recording_of(drive, freed_of_motion(drive))
    found, verdict = with_times(recording)
    print(verdict.note)
    assert verdict.deskew == found.deskew == "compensated"
    assert not found.read(20).t_offset_ns.any()
    assert len(found.read(20)) == len(recording.read(20))


def test_a_vehicle_that_stands_decides_nothing(drive):
    recording = recording_of(drive, ring_by_ring)
    scan = recording.read(0)
    t_ns = recording.t_ns[:12]
    still = dataclasses.replace(
        recording, t_ns=t_ns, read=lambda i: dataclasses.replace(scan, t_ns=int(recording.t_ns[i]))
    )
    found, verdict = with_times(still)
    assert verdict.deskew == found.deskew == "none"
    assert "too little to tell" in verdict.note
    assert found.sweep_ns == SWEEP_NS
    assert not found.read(3).t_offset_ns.any()


def test_a_few_scans_decide_nothing(drive):
    recording = recording_of(drive, ring_by_ring)
    found, verdict = with_times(dataclasses.replace(recording, t_ns=recording.t_ns[40:51]))
    assert verdict.deskew == found.deskew == "none"
    assert "11 scans, 12 are needed" in verdict.note


def test_recordings_that_give_times_keep_them(drive):
    found, verdict = with_times(recording_of(drive, lambda scan: scan))
    assert (found.deskew, verdict.note) == ("measured", "")
    np.testing.assert_array_equal(found.read(3).t_offset_ns, scans_of(drive)[3].t_offset_ns)
    said = recording_of(drive, without_times, deskew="compensated")
    assert with_times(said)[0] is said


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("begin_deg", [-180.0, -90.0, 0.0, 135.0])
def test_a_saw_tooth_is_found_through_noise_and_gaps(begin_deg, clockwise):
    sweep, rng = FoundSweep(np.radians(begin_deg), clockwise), np.random.default_rng(3)
    sigma = rng.uniform(0.02, 0.3, BINS)
    sigma[20:30] = 100.0  # nothing seen there
    tau = sweep.share(middle_of_bins_rad()) - 0.2 + sigma * rng.normal(size=BINS)
    fit = fit_sweep(AzimuthTimes(tau, np.diag(sigma**-2)))
    assert fit.sweep.clockwise == clockwise
    assert abs(np.angle(np.exp(1j * (fit.sweep.begin_rad - sweep.begin_rad)))) < np.radians(11.0)
    assert fit.motion == pytest.approx(1.0, abs=4.0 * fit.motion_sigma)
    assert min(fit.rival, fit.still) > 9.0


def test_no_motion_in_the_points_is_no_saw_tooth():
    rng = np.random.default_rng(4)
    fit = fit_sweep(AzimuthTimes(0.05 * rng.normal(size=BINS), np.diag(np.full(BINS, 0.05**-2))))
    assert fit.motion < 0.2


def test_points_where_the_sweep_begins_have_no_time():
    azimuth = np.radians([179.0, -179.0, 170.0, 0.0]).astype(np.float32)
    points = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(4)]).astype(np.float32)
    share = share_by_azimuth(FoundSweep(np.pi, True))(without_times(Scan(0, points, np.zeros(4, np.uint32))))
    assert np.isnan(share[:2]).all()
    np.testing.assert_allclose(share[2:], [10 / 360, 0.5], atol=1e-3)


def test_a_thicker_wall_is_told_and_too_few_decide_nothing():
    rng = np.random.default_rng(5)
    walls = [rng.uniform((0, 0.25, 0), (60, 0.25, 8), (30_000, 3)) for _ in range(4)]
    thin = thickness_of([wall + rng.normal(0, (0, 0.02, 0), wall.shape) for wall in walls])
    thick = thickness_of([wall + rng.normal(0, (0, 0.03, 0), wall.shape) for wall in walls])
    assert thin.mean_m == pytest.approx(0.02, rel=0.25)
    gain = compared(thick, thin)
    assert gain.percent > 20.0
    assert gain.by(0.01, 3.0)
    assert not compared(thin, thick).by(0.01, 3.0)
    few = dataclasses.replace(thin, key=thin.key[:9], sigma_m=thin.sigma_m[:9])
    assert not compared(thick, few).by(0.0, 1.0)
