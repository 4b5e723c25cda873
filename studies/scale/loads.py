"""Measured loads as they are committed beside the model: settings, figures, and the streets that were driven."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from statistics import median
from typing import Any, Literal

from gnd.deploy.load.plan import LoadOptions
from studies.frame.errors import OptionError

Kind = Literal["file", "postgresql"]
KINDS: tuple[Kind, ...] = ("file", "postgresql")


@dataclass(frozen=True, slots=True)
class LoadSetting:
    """One load: what `gnd load` is told.

    Attributes:
        use: "fit": costs are taken from it; "compared": the model has to foretell it, and its rules were chosen while
            these were known; "unseen": it was measured when the model was finished.
        vehicles, changed_share, shards, kmh, km: as `gnd load` has them.
    """

    use: Literal["fit", "compared", "unseen"]
    vehicles: int
    changed_share: float
    shards: int = 2
    kmh: float = 60.0
    km: float = 0.4

    def options(self, drain_s: float = 10.0) -> LoadOptions:
        """For `gnd load`."""
        return LoadOptions(
            vehicles=self.vehicles,
            changed_share=self.changed_share,
            shards=self.shards,
            kmh=self.kmh,
            km=self.km,
            drain_s=drain_s,
        )


@dataclass(frozen=True, slots=True)
class MeasuredLoad:
    """What came of a load.

    Attributes:
        setting: what was asked for.
        store: "file" or "postgresql".
        at: date.
        reports, halves: acknowledged; second halves of them.
        tiles_told, tiles_asked: parts of first and of second halves in the journal.
        versions, parts_merged: versions published; report parts that they were made of.
        offered_s, drained_s: from the first report to the last, and until nothing waited any more.
        ack_ms, lag_s: quantiles, see docs/load.md.
        cpu_s: of the parts of the cloud.
        client_cpu_s: of the clients.
        unit_ms: CPU of a unit of work of the yardstick, done on the same core in the same time: what the core was worth
            beside its neighbours.
        core, load_average: where and when it was measured.
    """

    setting: LoadSetting
    store: Kind
    at: str
    reports: int
    halves: int
    tiles_told: int
    tiles_asked: int
    versions: int
    parts_merged: int
    offered_s: float
    drained_s: float
    ack_ms: Mapping[str, float]
    lag_s: Mapping[str, float]
    cpu_s: Mapping[str, float]
    client_cpu_s: float
    unit_ms: float
    core: int = 0
    load_average: float = 0.0

    def __post_init__(self) -> None:
        if self.store not in KINDS or not (self.reports > 0 and 0 < self.offered_s <= self.drained_s):
            raise OptionError(
                f"no load: store {self.store}, {self.reports} reports in {self.offered_s} s, {self.drained_s} s"
            )
        if not self.unit_ms > 0.0:
            raise OptionError(f"no load: a unit of the yardstick took {self.unit_ms} ms")

    @property
    def reports_per_s(self) -> float:
        """From the first report until nothing waited any more."""
        return self.reports / self.drained_s

    @property
    def core_share(self) -> float:
        """CPU of the cloud and its clients that the reports took, to the time in which they were sent."""
        return (self.cloud_cpu_s + self.client_cpu_s) / self.offered_s

    @property
    def cloud_cpu_s(self) -> float:
        """Of all parts of the cloud."""
        return sum(self.cpu_s.values())


@dataclass(frozen=True, slots=True)
class ReportOfDrive:
    """Where a vehicle reports, and about what: (number of the tile, whether nothing has changed there: 0, 1)."""

    at_m: float
    tiles: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class StreetOfLoad:
    """The street of which a load has copies, with the drives along it."""

    length_m: float
    drives: tuple[tuple[ReportOfDrive, ...], ...]

    @property
    def at_m(self) -> tuple[tuple[float, ...], ...]:
        """Where each drive reports."""
        return tuple(tuple(report.at_m for report in drive) for drive in self.drives)

    @property
    def disputed(self) -> frozenset[int]:
        """Tiles of which any drive says that something has changed."""
        reports = [report for drive in self.drives for report in drive]
        return frozenset(tile for report in reports for tile, quiet in report.tiles if not quiet)

    @property
    def changed_tiles(self) -> float:
        """Tiles a report, of which it says that something has changed."""
        reports = [report for drive in self.drives for report in drive]
        return sum(not quiet for report in reports for _, quiet in report.tiles) / len(reports)


@dataclass(frozen=True, slots=True)
class WorkerCosts:
    """What one worker takes, without a bus.

    Attributes:
        flags_ms_a_tile: CPU from flags to the journal for a tile.
        half_ms: CPU from Gaussians to the journal for a report.
        tiles_a_report: in the reports that were taken for this.
        again: of streets of each edition, merges of tiles about which nothing has come, for each of the others.
        unit_ms: as a load has it.
    """

    flags_ms_a_tile: float
    half_ms: float
    tiles_a_report: float
    again: Mapping[str, float]
    unit_ms: float


@dataclass(frozen=True, slots=True)
class Loads:
    """All that was measured, and where."""

    machine: str
    worker: WorkerCosts
    loads: tuple[MeasuredLoad, ...]
    streets: Mapping[str, StreetOfLoad]

    @classmethod
    def read(cls, text: str | None = None) -> "Loads":
        """From the JSON that `measure` writes; None: that which is committed."""
        told = json.loads(text or resources.files(__package__).joinpath("loads.json").read_text(encoding="utf-8"))
        loads = tuple(MeasuredLoad(**one | {"setting": LoadSetting(**one["setting"])}) for one in told["loads"])
        worker = WorkerCosts(**told["worker"])
        return cls(told["machine"], worker, loads, {name: _street(one) for name, one in told["streets"].items()})

    def of(self, store: Kind, use: str) -> list[MeasuredLoad]:
        """Those with a store that are to be fitted on, or compared: of each setting the medians of its runs."""
        found: dict[LoadSetting, list[MeasuredLoad]] = {}
        for one in self.loads:
            if one.store == store and one.setting.use == use:
                found.setdefault(one.setting, []).append(one)
        return [_median_of(some) for some in found.values()]

    def runs(self, load: MeasuredLoad) -> int:
        """How often a setting was measured."""
        return sum(one.setting == load.setting and one.store == load.store for one in self.loads)


def _median_of(loads: list[MeasuredLoad]) -> MeasuredLoad:
    """Each figure's median; counts of a load are the same in all of its runs, versions are not."""

    def table(of: str) -> dict[str, float]:
        return {name: median(getattr(one, of)[name] for one in loads) for name in getattr(loads[0], of)}

    return replace(
        loads[0],
        versions=round(median(one.versions for one in loads)),
        offered_s=median(one.offered_s for one in loads),
        drained_s=median(one.drained_s for one in loads),
        client_cpu_s=median(one.client_cpu_s for one in loads),
        unit_ms=median(one.unit_ms for one in loads),
        ack_ms=table("ack_ms"),
        lag_s=table("lag_s"),
        cpu_s=table("cpu_s"),
    )


def _street(told: Mapping[str, Any]) -> StreetOfLoad:
    drives = [
        [ReportOfDrive(one["at_m"], tuple((int(n), int(quiet)) for n, quiet in one["tiles"])) for one in drive]
        for drive in told["drives"]
    ]
    return StreetOfLoad(told["length_m"], tuple(map(tuple, drives)))
