"""Why a vehicle does not fully believe what it reports of a tile: the reasons and the figures behind them."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Final

from gnd.schemas.errors import BadValue
from gnd.schemas.generated import doubt_pb2
from gnd.schemas.wire import check_unsigned

_REASON_BITS: Final = 32
_COUNT_BITS: Final = 32
_PERMILLE: Final = 1000
MAX_SHIFT_MM: Final = 100_000
MAX_TURN_10URAD: Final = 314_160
_RAD_PER_STEP: Final = 1e-5
_M_PER_STEP: Final = 1e-3


class DoubtReason(IntFlag):
    """Reasons, each a bit; a tile may have several. Bits that are not named here come from a newer version."""

    NONE = 0
    EXPLAINED_BY_SHIFT = 1
    """A common small shift of the scans explains the changes."""
    IMPLAUSIBLE_SHARE = 2
    """More has changed than the time since the base makes plausible."""
    HEALTH_NOT_GOOD = 4
    """Localisation was not good while the tile was seen; scans of that time do not count, those near it do."""
    ESTIMATES_DISAGREE = 8
    """Refined and online poses differ by more than both their sigmas."""
    POSE_NOT_CHECKED = 16
    """Too little stands there to tell a shift from a change."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Doubt about one tile of a report, in the steps that it travels in.

    The shift is what lays the measurements onto the base, along the vehicle's axes: its poses seem to be off by it.
    """

    reasons: DoubtReason
    """At least one."""
    withheld: int = 0
    """So many changed voxels are held back; above 0 the tile names no voxel, neither observed nor changed."""
    explained_permille: int = 0
    """Of the changed voxels those whose measurements fit the base after the shift."""
    changed_permille: int = 0
    """Of the voxels that hold something in the base or now those changed."""
    uncertain_permille: int = 0
    """Of the scans around the tile those whose poses were not good enough to speak about the world."""
    forward_mm: int = 0
    left_mm: int = 0
    up_mm: int = 0
    turn_10urad: int = 0
    """Heading, counter-clockwise seen from above."""

    def __post_init__(self) -> None:
        check_unsigned("reasons of doubt", self.reasons, bits=_REASON_BITS)
        check_unsigned("withheld", self.withheld, bits=_COUNT_BITS)
        if not self.reasons:
            raise BadValue("doubt without a reason")
        for name in ("explained_permille", "changed_permille", "uncertain_permille"):
            _check(name, getattr(self, name), 0, _PERMILLE)
        for name in ("forward_mm", "left_mm", "up_mm"):
            _check(name, getattr(self, name), -MAX_SHIFT_MM, MAX_SHIFT_MM)
        _check("turn_10urad", self.turn_10urad, -MAX_TURN_10URAD, MAX_TURN_10URAD)

    @property
    def shift_m(self) -> tuple[float, float, float]:
        """Forward, left, up."""
        return self.forward_mm * _M_PER_STEP, self.left_mm * _M_PER_STEP, self.up_mm * _M_PER_STEP

    @property
    def turn_rad(self) -> float:
        """Heading, counter-clockwise seen from above."""
        return self.turn_10urad * _RAD_PER_STEP

    @property
    def explained_share(self) -> float:
        """0 … 1."""
        return self.explained_permille / _PERMILLE

    @property
    def changed_share(self) -> float:
        """0 … 1."""
        return self.changed_permille / _PERMILLE

    @property
    def words(self) -> tuple[str, ...]:
        """The reasons that are known here, in words, in order of their bits."""
        return tuple(reason.name.lower() for reason in DoubtReason if reason & self.reasons and reason.name)


def tiles_by_reason(words: Mapping[str, int]) -> tuple[int, ...]:
    """Counts by word (`Doubt.words`) in the order of the bits, without zeros at the end."""
    counts = [words.get(reason.name.lower(), 0) for reason in DoubtReason if reason.name]
    while counts and not counts[-1]:
        counts.pop()
    return tuple(counts)


def doubt_message(doubt: Doubt) -> doubt_pb2.Doubt:
    """The value as gnd.v1.Doubt."""
    return doubt_pb2.Doubt(
        reasons=int(doubt.reasons),
        withheld=doubt.withheld,
        explained_permille=doubt.explained_permille,
        changed_permille=doubt.changed_permille,
        uncertain_permille=doubt.uncertain_permille,
        forward_mm=doubt.forward_mm,
        left_mm=doubt.left_mm,
        up_mm=doubt.up_mm,
        turn_10urad=doubt.turn_10urad,
    )


def doubt_value(message: doubt_pb2.Doubt) -> Doubt:
    """The value of gnd.v1.Doubt; `BadValue` for what cannot be."""
    return Doubt(
        reasons=DoubtReason(message.reasons),
        withheld=message.withheld,
        explained_permille=message.explained_permille,
        changed_permille=message.changed_permille,
        uncertain_permille=message.uncertain_permille,
        forward_mm=message.forward_mm,
        left_mm=message.left_mm,
        up_mm=message.up_mm,
        turn_10urad=message.turn_10urad,
    )


def _check(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise BadValue(f"{name} {value} is outside {low} .. {high}")
