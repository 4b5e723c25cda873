"""Versions on trial, as a store keeps them: who gets them, what vehicles tell of them, what became of them."""

from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Final, Literal

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError

TrialState = Literal["trial", "paused", "released", "withdrawn", "superseded"]
Settlement = Literal["released", "withdrawn"]
Arm = Literal["new", "old"]
"""Which version a vehicle has got: the one on trial, or the one before it."""

ARM_MOST: Final = 64
"""Vehicles that are heard of each arm of a trial, the first to speak; more would decide nothing else."""
SETTLED_KEPT: Final = 10_000
"""Settled trials of which is told, the newest."""


@dataclass(frozen=True, slots=True)
class TrialTerms:
    """How a version goes on trial: the share of the fleet that gets it, and for how long at most."""

    share: float
    longest_s: float

    def __post_init__(self) -> None:
        if not (0 < self.share <= 1 and self.longest_s > 0):
            raise StoreError(f"a trial with a share of {self.share} for {self.longest_s} s: 0 < share <= 1, time > 0")


@dataclass(frozen=True, slots=True)
class VersionTrial:
    """One version on trial, or what became of it.

    Attributes:
        base_version: the one that all others have meanwhile.
        share: of the fleet that gets it.
        longest_ns: after so long it is released if nobody drove there.
        since_ns: published, int ns UTC.
        settled_ns: None while it is open.
        verdict: JSON of what was decided on; "": nothing yet.
        base_sha, sha: of an open trial the hashes of both contents.
        salt: of the store, which the choice of vehicles depends on.
    """

    layer: str
    tile: TileId
    version: int
    base_version: int
    share: float
    longest_ns: int
    since_ns: int
    state: TrialState
    settled_ns: int | None = None
    verdict: str = ""
    base_sha: bytes = field(default=b"", repr=False)
    sha: bytes = field(default=b"", repr=False)
    salt: bytes = field(default=b"", repr=False)

    @property
    def place(self) -> tuple[str, TileId, int]:
        """Layer, tile and version."""
        return self.layer, self.tile, self.version

    @property
    def is_open(self) -> bool:
        """Whether it is not settled."""
        return self.state in ("trial", "paused")

    def is_among_first(self, ticket: int) -> bool:
        """Whether a vehicle gets the version on trial. Each tile has other first vehicles, drawn at random: that is
        what makes the comparison of both arms a fair one.
        """
        if ticket == 0:
            return False
        told = f"{self.layer}\0{self.tile.morton}\0{self.version}\0{ticket}".encode()
        drawn = int.from_bytes(blake2b(told, digest_size=4, key=self.salt).digest(), "little")
        return drawn < self.share * 2**32


@dataclass(frozen=True, slots=True)
class VehicleHealth:
    """What one vehicle has told of its visit to a tile on trial: one vote.

    Attributes:
        arm: which version it had.
        first_ns: when it was first heard of there, by receipt, int ns UTC.
        t_ns: of its newest message, by its own clock.
        scans: looked at. matched, fit, elsewhere: 1/1000, see tile_health.proto.
        inside, gated, not_good: scans inside the tile, and those of them in trouble.
        has_left: it has said that it left.
    """

    vehicle: str
    arm: Arm
    first_ns: int
    t_ns: int
    scans: int
    matched: int
    fit: int
    elsewhere: int
    inside: int
    gated: int
    not_good: int
    has_left: bool


@dataclass(frozen=True, slots=True)
class DoubtedReport:
    """A report behind a version that was withdrawn; `cleared_ns` None: it is still doubted."""

    version: int
    report_id: str
    vehicle: str
    since_ns: int
    cleared_ns: int | None
    cleared_by: str


@dataclass(frozen=True, slots=True)
class Steering:
    """Who did what to a version of a tile, and why: to a trial, or to a change that somebody looked at."""

    at_ns: int
    who: str
    action: str
    version: int
    why: str
