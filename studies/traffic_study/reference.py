"""What the papers report, what we set out to reach, and where the sizes of raw measurements come from."""

from typing import Final

PAPER_KM: Final = 0.11e6 / 56.32e3
"""Way of one drive of the GND paper, km: 0.11 MB uploaded at 56.32 kB/km (sections 7.5 and 8)."""
PAPER_DRIVES: Final = 38
PAPER_BYTES: Final = {
    "download.pcd": 19.37e6,
    "download.gnd": 3.36e6,
    "upload.single.pcd_changes": 2.06e6,
    "upload.single.gnd": 0.11e6,
    "upload.fleet.raw": 1713e6,
    "upload.fleet.pcd_changes": 89.24e6,
    "upload.fleet.gnd": 3.511e6,
}
"""GND paper, section 7.5 and Figure 23."""

PACKET_BYTES: Final = 1206
PACKET_SHOTS: Final = 384
"""A data packet of a Velodyne VLP-16: 12 blocks of a flag, an azimuth and 32 ranges with reflectivities, a time stamp
and two factory bytes (VLP-16 user manual, 63-9243). Every shot is in it, with an echo or without."""
