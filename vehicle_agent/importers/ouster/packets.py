"""How Ouster's lidar packets are laid out: profiles, and a packet as one record of numpy.

Source: Ouster Firmware User Manual, "Lidar Data Packet Format"; each profile is held against ouster-sdk in
tests/importer/test_ouster_golden.py. A packet has a header (none in LEGACY), columns (each with a header, a pixel a
beam, and in LEGACY a footer) and a footer (none in LEGACY). All numbers are little-endian.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.drive import U32

FRAMING_BYTES: Final = 32
"""Header of a packet, and its footer."""
LIDAR_PACKET: Final = 1
"""Type of packet in the header."""
VALID: Final = 1
"""Bit of a column's status: it was measured."""


@dataclass(frozen=True, slots=True)
class LidarProfile:
    """A pixel: its length, the bits of a range and the factor to mm, and how many returns it has.

    The first range is at byte 0, the second at byte 4. legacy: columns with a header and a footer of their own, no
    header of the packet. wide: the safety header (FUSA), whose frame number has 32 bits.
    """

    name: str
    pixel_bytes: int
    range_bits: int
    factor_mm: int = 1
    returns: int = 1
    legacy: bool = False
    wide: bool = False

    def packet_bytes(self, n_beams: int, n_columns: int) -> int:
        """Length of a packet."""
        around = 20 if self.legacy else 12
        return n_columns * (around + n_beams * self.pixel_bytes) + (0 if self.legacy else 2 * FRAMING_BYTES)

    @property
    def frame_bits(self) -> int:
        """Bits of the frame number, which begins again at 0."""
        return 32 if self.wide else 16


PROFILES: Final = {
    one.name: one
    for one in (
        LidarProfile("LEGACY", 12, 20, legacy=True),
        LidarProfile("RNG19_RFL8_SIG16_NIR16", 12, 19),
        LidarProfile("RNG19_RFL8_SIG16_NIR16_DUAL", 16, 19, returns=2),
        LidarProfile("RNG15_RFL8_NIR8", 4, 15, 8),
        LidarProfile("RNG15_RFL8_NIR8_DUAL", 8, 15, 8, returns=2),
        LidarProfile("FUSA_RNG15_RFL8_NIR8_DUAL", 8, 15, 8, returns=2, wide=True),
        LidarProfile("RNG15_RFL8_WIN8", 4, 15, 8),
        LidarProfile("RNG15_RFL8_NIR8_ZONE16", 8, 15, 8),
        LidarProfile("RNG19_RFL8_SIG16_NIR16_ZONE16", 12, 19),
        LidarProfile("RNG19_RFL8_SIG16_ZONE16_DUAL", 16, 19, returns=2),
    )
}
BEAMS: Final = (16, 32, 64, 128)
USUAL_COLUMNS: Final = 16


def packet_dtype(profile: LidarProfile, n_beams: int, n_columns: int) -> np.dtype[np.void]:
    """A packet as one record: frame_id, serial, columns (t_ns, measurement_id, status, range, range2)."""
    word = "<u2" if profile.range_bits == 15 else "<u4"
    pixel = np.dtype({
        "names": ["range", "range2"][: profile.returns],
        "formats": [word] * profile.returns,
        "offsets": [0, 4][: profile.returns],
        "itemsize": profile.pixel_bytes,
    })  # fmt: skip
    head, foot = (16, 4) if profile.legacy else (12, 0)
    status_at = head + n_beams * profile.pixel_bytes if profile.legacy else 10
    column = np.dtype({
        "names": ["t_ns", "measurement_id", "status", "pixels"],
        "formats": ["<u8", "<u2", "<u2", (pixel, (n_beams,))],
        "offsets": [0, 8, status_at, head],
        "itemsize": head + n_beams * profile.pixel_bytes + foot,
    })  # fmt: skip
    frame_at = 10 if profile.legacy else 4 if profile.wide else 2
    return np.dtype({
        "names": ["frame_id", "columns"],
        "formats": ["<u4" if profile.wide else "<u2", (column, (n_columns,))],
        "offsets": [frame_at, 0 if profile.legacy else FRAMING_BYTES],
        "itemsize": profile.packet_bytes(n_beams, n_columns),
    })  # fmt: skip


def serial_of(profile: LidarProfile, payload: bytes) -> int:
    """Serial number of the sensor in a packet; 0 where it says none."""
    if profile.legacy:
        return 0
    at = 11 if profile.wide else 7
    return int.from_bytes(payload[at : at + 5], "little")


def is_lidar(profile: LidarProfile, payload: bytes) -> bool:
    """Whether a packet of the right length says that it is one of points."""
    if profile.legacy:
        return True
    return (payload[0] if profile.wide else int.from_bytes(payload[:2], "little")) == LIDAR_PACKET


def ranges_mm(profile: LidarProfile, pixels: NDArray[np.void]) -> tuple[U32, ...]:
    """The ranges of each return, mm; 0: none. Shape as `pixels`."""
    mask = np.uint32((1 << profile.range_bits) - 1)
    return tuple(
        (pixels[name].astype(np.uint32) & mask) * np.uint32(profile.factor_mm)
        for name in ("range", "range2")[: profile.returns]
    )


def kinds_of_size(n_bytes: int) -> list[tuple[LidarProfile, int]]:
    """The profiles, and numbers of beams, whose packets are so long."""
    return [
        (profile, beams)
        for profile in PROFILES.values()
        for beams in BEAMS
        if profile.packet_bytes(beams, USUAL_COLUMNS) == n_bytes
    ]
