"""What a header says of the points' times and of the mount, in files of today and of before."""

import dataclasses
import math

import numpy as np
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, MountSigma
from gnd.schemas.drive_metadata import header_of, metadata_of
from gnd.schemas.errors import BadValue, DriveError, NoPlace
from gnd.schemas.sweep_distortion import distortion_sigma

OLD = DriveHeader("drive-1", "car-1", "VLP-16", LocalFrame(0.6555, 2.2172, 30.25), np.eye(4), "made by a test")
OLD_KEYS = {
    "drive_id", "vehicle", "sensor_model", "source", "crc32", "map_anchor_lat_rad", "map_anchor_lon_rad",
    "map_anchor_height_m",
}  # fmt: skip


def test_a_header_that_says_nothing_new_is_written_as_before():
    assert set(metadata_of(OLD)) == OLD_KEYS
    assert header_of(metadata_of(OLD), np.eye(4)) == OLD
    assert (OLD.deskew, OLD.mount, OLD.sweep_ns, OLD.mount_sigma) == ("unsaid", "unsaid", 0, None)


@pytest.mark.parametrize("deskew", ["measured", "reconstructed", "compensated", "none"])
@pytest.mark.parametrize(
    ("mount", "sigma"),
    [("given", None), ("assumed", None), ("estimated", MountSigma(0.01, 1e-3, 2e-3, math.inf))],
)
def test_what_is_said_is_read_back(deskew, mount, sigma):
    header = dataclasses.replace(OLD, deskew=deskew, sweep_ns=103_557_102, mount=mount, mount_sigma=sigma)
    assert header != OLD
    assert header_of(metadata_of(header), np.eye(4)) == header


@pytest.mark.parametrize("nowhere", [False, True])
@pytest.mark.parametrize("stand_ins", [(), ("gnss",), ("gnss", "motion")])
def test_place_and_stand_ins_are_read_back(nowhere, stand_ins):
    header = dataclasses.replace(OLD, nowhere=nowhere, stand_ins=stand_ins)
    assert (header == OLD) == (not nowhere and not stand_ins)
    assert header_of(metadata_of(header), np.eye(4)) == header
    if nowhere:
        with pytest.raises(NoPlace, match="--nowhere"):
            header.check_placed()
    else:
        header.check_placed()


@pytest.mark.parametrize(
    "wrong",
    [
        {"stand_ins": ("wheels",)},
        {"deskew": "yes"},
        {"mount": "by hand"},
        {"sweep_ns": -1},
        {"mount": "estimated"},
        {"mount": "given", "mount_sigma": MountSigma(0.0, 0.0, 0.0, 0.0)},
        {"mount": "estimated", "mount_sigma": MountSigma(0.0, -1.0, 0.0, 0.0)},
        {"mount": "estimated", "mount_sigma": MountSigma(math.nan, 0.0, 0.0, 0.0)},
    ],
)
def test_a_header_that_cannot_be_is_refused(wrong):
    with pytest.raises(BadValue):
        dataclasses.replace(OLD, **wrong)


def test_damaged_metadata_is_refused():
    metadata = metadata_of(dataclasses.replace(OLD, mount="estimated", mount_sigma=MountSigma(0.01, 0.0, 0.0, 0.0)))
    with pytest.raises(DriveError, match="damaged"):
        header_of(metadata | {"mount": "given"}, np.eye(4))


def test_only_what_is_not_known_distorts():
    assert distortion_sigma("measured", 20.0, 0.5) == (0.0, 0.0, 0.0)
    assert distortion_sigma("compensated", 20.0, 0.5, 100_000_000) == (0.0, 0.0, 0.0)
    assert distortion_sigma("none", 0.0, 0.0) == (0.0, 0.0, 0.0)


def test_what_is_not_known_grows_with_speed_turn_and_sweep():
    """Against times drawn at random: what a point 10 m ahead or aside is off by."""
    t_s = np.random.default_rng(0).uniform(-0.05, 0.05, 100_000)
    sigma = distortion_sigma("none", -20.0, -0.3, 100_000_000)
    assert sigma.along_m == pytest.approx((20.0 * t_s).std(), rel=0.01)
    assert sigma.across_m == pytest.approx((10.0 * 0.3 * t_s).std(), rel=0.01)
    assert sigma.heading_rad > (0.3 * t_s).std()
    assert distortion_sigma("none", 20.0, 0.3) == sigma  # 10 Hz unless told
    assert distortion_sigma("none", 20.0, 0.3, 50_000_000).along_m == pytest.approx(sigma.along_m / 2)
    assert 0.0 < distortion_sigma("reconstructed", 20.0, 0.3).along_m < 0.05 * sigma.along_m
