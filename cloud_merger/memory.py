"""What a tile remembers of the windows that are closed, beside the map itself: a bounded summary a voxel.

- *Support*: by how many vehicles the voxel's present state was confirmed, by whom last, and on which day it was last
  observed. It weighs as that many votes, few at most, fewer with time: a settled voxel does not change on one vehicle's
  word, and a world that changes is followed all the same.
- *Claims*: what vehicles said against the present state and nobody has decided yet, of each voxel the newest, of each
  vehicle at most two. They vote in the windows that come, so vehicles that each saw too little decide together; each
  later confirmation of the present state takes the oldest one away.
- *Parked things*: since when something with the shape of a vehicle stands in a voxel, and how often something has gone
  from there (`gnd.cloud_merger.parked`).

Nothing here grows with the number of reports.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final
from zlib import crc32

import numpy as np
import zstandard
from numpy.typing import NDArray

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.statements import (
    EPOCH,
    STATEMENT,
    Kind,
    Report,
    Rows,
    Witness,
    find,
    is_met,
    stacked,
    states_at,
)
from gnd.gnd_map.bounded import json_value, zstd_unpacked
from gnd.gnd_map.gaussian import Gaussians

I32 = NDArray[np.int32]

CONFIRMED_BY: Final = np.array([0, 1, 2, 3, 5, 7, 15, 40, 100])
SUPPORT: Final = np.array([0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0])
"""Votes of a state that so many vehicles have confirmed. Where only one vehicle drives, its second drive outvotes it;
what seven have confirmed takes five that agree, and two never do; where a hundred came by, ten soon come."""
HALF_LIFE_DAYS: Final = 90.0
"""What nobody has observed for so long has half of them left."""
CLAIMS_OF_VOXEL: Final = 12
CLAIMS_OF_VEHICLE: Final = 2
"""A vehicle's claim of an earlier drive stays beside its newest one: saying the same again makes a second witness."""
ANOTHER_DRIVE_S: Final = 1800.0
"""Votes of one vehicle within so long, by receipt, are one vote, in however many windows they fall."""
MOST_OBSERVERS: Final = 255
_FORMAT: Final = 2
"""1: without parked things."""
_LEVEL: Final = 3
_MAX_BYTES: Final = 1 << 27
"""Unpacked: a tile's 200,000 voxels with eight claims each need as much."""
_NS_PER_S: Final = 1_000_000_000

# One remembered voxel. `observers`: vehicles that confirmed its state, counted up to 255; `last`: 16 bits of the hash
# of the one that did so last; `day`: of the last observation, `gnd.gnd_map.day`.
VOXEL: Final = np.dtype([("voxel_id", np.int32), ("observers", np.uint8), ("last", np.uint16), ("day", np.uint16)])

# One voxel in which something with the shape of a vehicle stands or stood. `since_ns`: since when it was seen there
# without a break, UTC; 0: nothing stands. `goings`: how often something has gone from there, counted up to 255.
PARKED: Final = np.dtype([("voxel_id", np.int32), ("since_ns", np.int64), ("goings", np.uint8)])
ParkedVoxels = NDArray[Any]  # of dtype PARKED, sorted by voxel


@dataclass(frozen=True, slots=True, eq=False)
class TileMemory:
    """See the module's head.

    Attributes:
        voxels: VOXEL (N,) sorted by voxel id.
        claims: STATEMENT (M,) by voxel, then by receipt; `report` indexes `witnesses`.
        witnesses: the reports that claim them, without what they say.
        voters: of each vehicle that voted within the last half hour of a closed window, when its newest report was
            received, int ns UTC.
        parked: PARKED (P,) sorted by voxel id.
    """

    voxels: NDArray[Any] = field(default_factory=lambda: np.zeros(0, VOXEL))
    claims: Rows = field(default_factory=lambda: np.zeros(0, STATEMENT))
    witnesses: tuple[Witness, ...] = ()
    voters: Mapping[str, int] = field(default_factory=dict)
    parked: ParkedVoxels = field(default_factory=lambda: np.zeros(0, PARKED))

    def __post_init__(self) -> None:
        if self.voxels.dtype != VOXEL or self.claims.dtype != STATEMENT or self.parked.dtype != PARKED:
            raise MergerError(f"a memory of {self.voxels.dtype}, {self.claims.dtype} and {self.parked.dtype}")
        for rows in (self.voxels, self.parked):
            if (np.diff(rows["voxel_id"]) <= 0).any():
                raise MergerError(f"a memory of {len(rows)} voxels that are not strictly ascending")
        if len(self.claims) and not 0 <= self.claims["report"].min() <= self.claims["report"].max() < len(
            self.witnesses
        ):
            raise MergerError(f"claims of {self.claims['report'].max() + 1} witnesses, there are {len(self.witnesses)}")

    def is_fresh(self, report: Report) -> bool:
        """Whether the vehicle has not voted in the closed windows of the last half hour."""
        return report.received_ns - self.voters.get(report.vehicle, -(1 << 62)) >= ANOTHER_DRIVE_S * _NS_PER_S

    def support_rows(self, voxels: I32, epoch: Gaussians, day: int) -> Rows:
        """STATEMENT rows that stand for what the present state of some voxels is worth on a day; `report` is -1."""
        support = self.support(voxels, day)
        known = support > 0.0
        support, said = support[known], states_at(epoch, voxels[known], Kind.QUOTED)
        said["was"] = np.where(said["kind"] == Kind.QUOTED, EPOCH, 0)
        said["report"] = -1
        turns = [np.clip(support - turn, 0.0, 1.0) for turn in range(int(SUPPORT[-1]))]
        rows = stacked([said] * len(turns))
        rows["weight"] = np.concatenate(turns) if turns else 0.0
        spoken: Rows = rows[rows["weight"] > 0.0]
        return spoken

    def support(self, voxels: I32, day: int) -> NDArray[np.float64]:
        """(N,) what the present state of some voxels is worth on a day, in votes; 0 where nothing is remembered."""
        at = find(self.voxels["voxel_id"], voxels)
        of = self.voxels[at[at >= 0]]
        age_days = np.maximum(day - of["day"].astype(np.int64), 0)
        votes = SUPPORT[np.searchsorted(CONFIRMED_BY, of["observers"], side="right") - 1]
        found = np.zeros(len(voxels))
        found[at >= 0] = votes * 0.5 ** (age_days / HALF_LIFE_DAYS)
        return found

    def claims_beside(self, reports: Sequence[Report]) -> Rows:
        """The claims that vote beside the reports of a window. Where a vehicle speaks again about a voxel, its newest
        earlier claim stays as that of another drive, unless that was less than half an hour ago: then it is replaced.
        """
        stays = np.ones(len(self.claims), bool)
        for vehicle in {one.vehicle for one in reports if one.vehicle}:
            own = [k for k, one in enumerate(self.witnesses) if one.vehicle == vehicle]
            if own:
                speaks = [one for one in reports if one.vehicle == vehicle]
                spoken_of = [ids for one in speaks for ids in (one.change.observed, one.change.unsure.voxel_id)]
                again = np.isin(self.claims["voxel_id"], np.concatenate(spoken_of))
                again &= np.isin(self.claims["report"], own)
                at = np.flatnonzero(again)  # by voxel, the newest last
                voxel = self.claims["voxel_id"][at]
                newest = np.append(voxel[1:] != voxel[:-1], True)[: len(at)]
                stays[at[~newest] if all(map(self.is_fresh, speaks)) else at] = False
        kept: Rows = self.claims[stays]
        return kept

    def without_met(self) -> "TileMemory":
        """The same without votes by what vehicles met and did not decide upon."""
        met = is_met(self.claims)
        return replace(self, claims=self.claims[~met]) if met.any() else self

    def encode(self) -> bytes:
        """Bytes for the store: a head in JSON, the columns of voxels, the claims; zstd."""
        head = json.dumps(
            {
                "format": _FORMAT,
                "voxels": len(self.voxels),
                "claims": len(self.claims),
                "witnesses": [_told(one) for one in self.witnesses],
                "voters": dict(self.voters),
                "parked": len(self.parked),
            }
        ).encode()
        columns = [np.ascontiguousarray(self.voxels[name]).tobytes() for name in ("observers", "last", "day")]
        ids = np.diff(self.voxels["voxel_id"], prepend=np.int32(0)).astype("<i4").tobytes()
        parts = [len(head).to_bytes(4, "little"), head, ids, *columns, self.claims.tobytes(), self.parked.tobytes()]
        return zstandard.ZstdCompressor(level=_LEVEL).compress(b"".join(parts))

    @classmethod
    def decode(cls, body: bytes) -> "TileMemory":
        """The memory in `body`.

        Raises:
            MergerError: it is damaged or of another format.
        """
        try:
            data = zstd_unpacked(body, _MAX_BYTES)
            at = 4 + int.from_bytes(data[:4], "little")
            head = json_value(data[4:at])
            if head["format"] not in (1, _FORMAT):
                raise MergerError(f"a memory of format {head['format']}, this release reads 1 to {_FORMAT}")
            rest = memoryview(data)[at:]
            n, n_claims, n_parked = (_count(head.get(name, 0), rest) for name in ("voxels", "claims", "parked"))
            voxels = np.zeros(n, VOXEL)
            voxels["voxel_id"] = np.cumsum(np.frombuffer(rest[: 4 * n], "<i4"))
            first = 4 * n
            for name in ("observers", "last", "day"):
                size = VOXEL[name].itemsize * n
                voxels[name] = np.frombuffer(rest[first : first + size], VOXEL[name])
                first += size
            claims = np.frombuffer(rest[first:], STATEMENT, n_claims).copy()
            parked = np.frombuffer(rest[first + claims.nbytes :], PARKED, n_parked).copy()
            return cls(voxels, claims, tuple(Witness(**one) for one in head["witnesses"]), head["voters"], parked)
        except (ValueError, KeyError, TypeError) as error:
            raise MergerError(f"a memory of {len(body)} bytes cannot be read: {error}") from error


def mark_of(vehicle: str) -> np.uint16:
    """What `last` remembers of a vehicle."""
    return np.uint16(crc32(vehicle.encode()) & 0xFFFF)


def _count(number: Any, data: memoryview) -> int:
    """A number of rows, each of a byte or more, in so many bytes; ValueError: it cannot be one."""
    if type(number) is not int or not 0 <= number <= len(data):
        raise ValueError(f"{number!r} rows in {len(data)} bytes")
    return number


def _told(witness: Witness) -> dict[str, Any]:
    return {name: getattr(witness, name) for name in Witness.__slots__}
