"""What the reports in play of a tile say, laid out flat: the votes about any voxels in one kernel, report by report.

A vehicle's flags are answered by what all others in the open window said about the same voxels. Reports are laid out
once and appended; nothing is read, decoded or laid out again for the next vehicle.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.statements import NO_BASE, Kind, Report, changed_of, index_of, same_state, states_at
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.jit import kernel

U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
_NOTHING, _QUOTED, _MEASURED = int(Kind.NOTHING), int(Kind.QUOTED), int(Kind.MEASURED)
_NO_ROWS: Final = np.zeros(1, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class TileVotes:
    """Reports in play of one tile, in the order in which they came; of an id that came again the last one counts.

    Attributes:
        report_ids: (R,).
        shas: content hashes of the versions that they were made against, each once.
        weight: (R,) of their votes; 0 for those that came again.
        base: (R,) index into `shas`.
        observed: the voxels that each saw, sorted, one report behind the other.
        observed_end: (R + 1,) where those of each end.
        changed: the voxels that each found changed, likewise.
        changed_end: (R + 1,).
        kind: of each changed voxel the `Kind` of statement.
        speaks: whether it is one.
    """

    report_ids: tuple[str, ...] = ()
    shas: tuple[bytes, ...] = ()
    weight: F64 = field(default_factory=lambda: np.zeros(0))
    base: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    observed: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    observed_end: I64 = field(default_factory=lambda: _NO_ROWS)
    changed: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    changed_end: I64 = field(default_factory=lambda: _NO_ROWS)
    kind: U8 = field(default_factory=lambda: np.zeros(0, np.uint8))
    speaks: Mask = field(default_factory=lambda: np.zeros(0, np.bool_))

    @classmethod
    def of(cls, reports: Iterable[Report]) -> "TileVotes":
        """The votes of these reports."""
        return cls().with_reports(reports)

    def with_reports(self, reports: Iterable[Report]) -> "TileVotes":
        """These, and those of more reports."""
        more = list(reports)
        if not more:
            return self
        laid_out = [changed_of(one.change) for one in more]
        shas = tuple(dict.fromkeys((*self.shas, *(one.change.base_sha for one in more))))
        report_ids = (*self.report_ids, *(one.report_id for one in more))
        last = {report_id: k for k, report_id in enumerate(report_ids)}
        weight = np.append(self.weight, [one.weight for one in more])
        weight[[k for k, report_id in enumerate(report_ids) if last[report_id] != k]] = 0.0
        observed, changed = [one.change.observed for one in more], [one.rows["voxel_id"] for one in laid_out]
        return replace(
            self,
            report_ids=report_ids,
            shas=shas,
            weight=weight,
            base=np.append(self.base, [shas.index(one.change.base_sha) for one in more]),
            observed=np.concatenate([self.observed, *observed]),
            observed_end=_ends(self.observed_end, observed),
            changed=np.concatenate([self.changed, *changed]),
            changed_end=_ends(self.changed_end, changed),
            kind=np.concatenate([self.kind, *(one.rows["kind"] for one in laid_out)]),
            speaks=np.concatenate([self.speaks, *(one.speaks for one in laid_out)]),
        )

    def about(
        self, voxel_id: I32, base_sha: bytes, bases: Mapping[bytes, Gaussians], but: str = ""
    ) -> tuple[F64, F64, F64]:
        """What they say of voxels that somebody flags, as `statements_of` has it, three counts of (N,).

        The first are the votes that may agree: not that there is nothing, nor a quotation of the very Gaussian that the
        flag denies. The second are all votes. The third tell how many measured a Gaussian against the same state.

        Args:
            voxel_id: (N,) sorted.
            base_sha: content hash of the version that the flags were made against.
            bases: Gaussians by content hash. Of an unknown base "as in base version" abstains.
            but: the report with this id does not count.
        """
        empty = Gaussians.empty()
        was = states_at(bases.get(base_sha, empty), voxel_id, Kind.QUOTED)
        held = [states_at(bases.get(sha, empty), voxel_id, Kind.QUOTED) for sha in self.shas]
        weight = self.weight.copy()
        weight[[k for k, report_id in enumerate(self.report_ids) if report_id == but]] = 0.0
        result = np.zeros((3, len(voxel_id)))
        _tally(
            voxel_id,
            np.array([rows["kind"] for rows in held], np.uint8).reshape(len(held), len(voxel_id)),
            np.array([same_state(was, rows) for rows in held], np.bool_).reshape(len(held), len(voxel_id)),
            np.array([sha in bases for sha in self.shas], np.bool_),
            weight, self.base, self.observed, self.observed_end, self.changed, self.changed_end, self.kind, self.speaks,
            result,
        )  # fmt: skip
        return result[0], result[1], result[2]


def quotable(bases: Mapping[bytes, Gaussians]) -> dict[bytes, Gaussians]:
    """The versions that "as in base version" may mean: these, and that of a vehicle without a map."""
    return {NO_BASE: Gaussians.empty(), **bases}


def _ends(ends: I64, parts: list[I32]) -> I64:
    return np.append(ends, ends[-1] + np.cumsum([len(part) for part in parts]))


@kernel
def _tally(
    voxel_id: I32, quoted: U8, same_was: Mask, is_known: Mask, weight: F64, base: I64, observed: I32,
    observed_end: I64, changed: I32, changed_end: I64, kind: U8, speaks: Mask, result: F64,
) -> None:  # fmt: skip
    """`TileVotes.about`: (S, N) the kind of state that each base quotes, and whether it is the flag's, are given."""
    for r in range(len(weight)):
        if weight[r] == 0.0:
            continue
        s = base[r]
        mine, seen = changed[changed_end[r] : changed_end[r + 1]], observed[observed_end[r] : observed_end[r + 1]]
        for k in range(len(voxel_id)):
            at = index_of(voxel_id[k], mine)
            if at >= 0:
                said, is_said = kind[changed_end[r] + at], speaks[changed_end[r] + at]
            else:
                said, is_said = quoted[s, k], is_known[s] and index_of(voxel_id[k], seen) >= 0
            if not is_said:
                continue
            result[1, k] += weight[r]
            if said == _NOTHING or (said == _QUOTED and same_was[s, k]):
                continue
            result[0, k] += weight[r]
            if said == _MEASURED and same_was[s, k]:
                result[2, k] += 1.0
