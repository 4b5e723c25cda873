"""What a real report in short costs the cloud, stage by stage, and how well the predicted lines of sight agree.

Drives through simulated streets (`gnd reproduce simulation --upload packed`) give each report whole, with the voxels
that the vehicle truly observed, and in short. Times are processor time of the thread; the yardstick, a sort of 100,000
numbers, tells how fast the machine was just then. Decision 0101.
"""

import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import thread_time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.expanding import base_versions, expand
from gnd.cloud_merger.merge import MergeParameters
from gnd.fleet_sim.evaluate import evaluate_maps
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.truth import read_truth
from gnd.gnd_map.codec import CODECS, Flags, decode_flags, snap
from gnd.gnd_map.codec.lattice import STANDARD
from gnd.gnd_map.codec.registry import CODEC_STANDARD
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile import Tile, apply, diff
from gnd.gnd_map.track import Track, decode_track
from gnd.gnd_map.visibility import observed_along
from gnd.schemas.changes import ChangeReport
from gnd.schemas.packed import PackedReport
from studies.frame.command import Bench
from studies.frame.folder import StudyFolder
from studies.frame.measure import Figure
from studies.frame.options import option, seeds
from studies.simulation.base_map import BaseMap
from studies.simulation.cloud import arrived, merged_map
from studies.simulation.options import RunOptions, Upload
from studies.simulation.result import VehicleResult
from studies.simulation.scores import Scored, VehicleFile
from studies.simulation.study import reproduce
from studies.simulation.worlds import WorldFiles, read_world_base

SENSORS = ("vlp16", "rs32", "hdl64e")
KINDS = ("with a Gaussian", "without", "next to a change")
_RUNS, _PAIRS = 5, 100_000


@dataclass(frozen=True, slots=True)
class ShortReportOptions:
    """Streets to drive, or a finished run."""

    seeds: tuple[int, ...] = seeds(21, text="Of the streets.")
    length_m: float = option(200.0, "Of a street, metres.", "--length")
    run: Path | None = option(None, "Folder of a finished `gnd reproduce simulation --upload packed` instead.")


OPTIONS: Final = ShortReportOptions


@dataclass(frozen=True, slots=True, eq=False)
class ShortReport:
    """One report: whole, in short, and the tiles that its vehicle compared with."""

    whole: ChangeReport
    body: bytes
    bases: tuple[Tile, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ReportStreet:
    """A world of a run with its drives."""

    files: WorldFiles
    base: BaseMap
    results: tuple[VehicleResult, ...]

    def reports(self) -> Iterator[ShortReport]:
        """Those that came in short."""
        for result in self.results:
            for whole, half in zip(result.reports, result.packed, strict=True):
                if half:
                    yield self._report(ChangeReport.decode(whole), half)

    def _report(self, whole: ChangeReport, body: bytes) -> ShortReport:
        versions = base_versions(PackedReport.decode(body), whole.district)
        tiles = [Tile(tile, version, self.base.tiles.get(tile, Gaussians.empty())) for tile, version in versions]
        return ShortReport(whole, body, tuple(tiles))


def run(chosen: ShortReportOptions | None = None) -> list[Figure]:
    """Measure the stages, the agreement and the merge."""
    wanted = chosen or ShortReportOptions()
    if wanted.run is not None:
        return _measure(_streets(StudyFolder(wanted.run), "surveyed"))
    with TemporaryDirectory() as folder:
        return _measure(_driven(wanted, Path(folder)))


def _driven(wanted: ShortReportOptions, folder: Path) -> list[ReportStreet]:
    fleet = RunOptions(
        seeds=wanted.seeds, street=StreetOptions(wanted.length_m, "wangsimni"), vehicles=(len(SENSORS),),
        sensors=SENSORS, pcd=False, upload="packed",
    )  # fmt: skip
    home = StudyFolder.create(folder / "run")
    outcome = reproduce(fleet, home, Bench(home))
    return [ReportStreet(world.files, read_world_base(world.files), world.vehicles) for world in outcome.worlds]


def _streets(folder: StudyFolder, base_kind: str) -> list[ReportStreet]:
    found = []
    for world in folder.finished()["worlds"]:
        files = WorldFiles(folder.root / world["folder"], base_kind)
        results = tuple(VehicleFile(folder.root / v["file"], v["key"]).read() for v in world["vehicles"])
        found.append(ReportStreet(files, read_world_base(files), results))
    return found


def _measure(streets: list[ReportStreet]) -> list[Figure]:
    reports = [report for street in streets for report in street.reports()]
    return [*_stages(reports), *_tiles(reports), *_agreement(reports), *_merges(streets)]


def _stages(reports: list[ShortReport]) -> list[Figure]:
    """Milliseconds a report of each stage."""
    spent: dict[str, list[float]] = {}
    yardstick = np.random.default_rng(0).random(100_000)
    for report in reports:
        for name, work in _works(report).items():
            spent.setdefault(name, []).append(_cpu_ms(work))
        spent.setdefault("yardstick: sort of 100,000", []).append(_cpu_ms(lambda: np.sort(yardstick)))
    size = f"{len(reports)} reports, median {statistics.median(len(r.bases) for r in reports):.0f} tiles"
    return [Figure(name, statistics.median(ms), "ms a report", f"{_spread(ms)}; {size}") for name, ms in spent.items()]


def _works(report: ShortReport) -> dict[str, Callable[[], object]]:
    packed, whole, bases = PackedReport.decode(report.body), report.whole, report.bases
    flags, track = _flags_of(report, packed), decode_track(whole.district, packed.track)
    made = expand(packed, whole.layer, whole.district, bases)
    body = made.encode()
    return {
        "read the message": lambda: PackedReport.decode(report.body),
        "read the flags": lambda: _flags_of(report, packed),
        "read the track": lambda: decode_track(whole.district, packed.track),
        "lines of sight": lambda: observed_along(track, flags),
        "all of it: bytes to statements": lambda: expand(
            PackedReport.decode(report.body), whole.layer, whole.district, bases
        ),
        "write the report whole": made.encode,
        "read it whole": lambda: ChangeReport.decode(body),
    }


def _flags_of(report: ShortReport, packed: PackedReport) -> list[Flags]:
    return decode_flags([(tile.tile_id, tile.gaussians) for tile in report.bases], packed.flags)


def _cpu_ms(work: Callable[[], object]) -> float:
    """Median processor time of a call, after one that is not counted."""
    work()
    times = []
    for _ in range(_RUNS):
        start_s = thread_time()
        work()
        times.append(1e3 * (thread_time() - start_s))
    return statistics.median(times)


def _spread(values: list[float]) -> str:
    low, high = np.percentile(values, [10, 90])
    return f"10 … 90 %: {low:.2f} … {high:.2f}"


def _tiles(reports: list[ShortReport]) -> list[Figure]:
    """What a tile costs that is published, and pairs of Gaussians."""
    standard = CODECS[CODEC_STANDARD]
    tiles = {t.tile_id: snap(t.gaussians, STANDARD) for r in reports for t in r.bases if len(t.gaussians)}
    bodies = {tile_id: standard.encode(tile_id, g) for tile_id, g in tiles.items()}
    voxels = sum(map(len, tiles.values()))
    write_ms = _cpu_ms(lambda: [standard.encode(tile_id, g) for tile_id, g in tiles.items()])
    read_ms = _cpu_ms(lambda: [standard.decode(tile_id, body) for tile_id, body in bodies.items()])
    change_ms = _cpu_ms(lambda: [apply(g, diff(g, g.take(np.arange(0, len(g), 2)))) for g in tiles.values()])
    size = f"{len(tiles)} tiles, {voxels} voxels"
    return [
        Figure("write tiles, standard lattice", voxels / write_ms / 1e3, "Mvoxel/s", size),
        Figure("read tiles, standard lattice", voxels / read_ms / 1e3, "Mvoxel/s", size),
        Figure("diff and apply", change_ms / len(tiles), "ms a tile", "half of the voxels go"),
        _pairs(list(tiles.values())),
    ]


def _pairs(tiles: list[Gaussians]) -> Figure:
    mean, cov = np.concatenate([g.mean_m for g in tiles]), np.concatenate([g.cov_m2 for g in tiles])
    i, j = np.random.default_rng(0).integers(0, len(mean), (2, _PAIRS))
    yes, one, other = np.ones(_PAIRS, np.bool_), (mean[i], cov[i]), (mean[j], cov[j])
    ms = _cpu_ms(lambda: similarity(yes, *one, yes, *other))
    return Figure("similarity", 1e6 * ms / _PAIRS, "ns a pair", f"{_PAIRS} pairs")


def _agreement(reports: list[ShortReport]) -> list[Figure]:
    """F1 of the voxels predicted as observed against those that the vehicles observed; flagged ones are left out."""
    counts = np.sum([_counts(report) for report in reports], axis=0)
    found = []
    for kind, (right, wrong, missed) in zip(KINDS, counts.tolist(), strict=True):
        precision, recall = 100.0 * right / max(right + wrong, 1), 100.0 * right / max(right + missed, 1)
        f1 = 200.0 * right / max(2 * right + wrong + missed, 1)
        detail = f"precision {precision:.1f}, recall {recall:.1f}, {right + missed:,.0f} observed"
        found.append(Figure(f"observed voxels {kind}, F1", f1, "%", detail))
    return found


def _counts(report: ShortReport) -> NDArray[np.int64]:
    """(KINDS, 3) voxels predicted rightly, predicted wrongly, missed."""
    packed = PackedReport.decode(report.body)
    flags = _flags_of(report, packed)
    track: Track = decode_track(report.whole.district, packed.track)
    predicted = observed_along(track, flags)
    counts = np.zeros((len(KINDS), 3), np.int64)
    for change, told in zip(report.whole.tiles, flags, strict=True):
        ids = np.setdiff1d(np.union1d(change.observed, predicted[told.tile_id]), told.voxel_id)
        true, said = np.isin(ids, change.observed), np.isin(ids, predicted[told.tile_id])
        held, near = np.isin(ids, told.base.voxel_id), np.isin(ids, _beside(told))
        for kind, of_kind in enumerate((held & ~near, ~held & ~near, near)):
            counts[kind] += [int((case & of_kind).sum()) for case in (true & said, said & ~true, true & ~said)]
    return counts


def _beside(told: Flags) -> NDArray[np.int64]:
    """Ids of voxels across a face of a flagged one, within the tile's rows of ids."""
    grid, ids = VoxelGrid.of(told.tile_id), told.voxel_id.astype(np.int64)
    return np.concatenate([ids + step for size in (1, grid.nx, grid.nx * grid.ny) for step in (-size, size)])


def _merges(streets: list[ReportStreet]) -> list[Figure]:
    """Macro F1 of the merged maps, all vehicles, with whole reports and with those in short."""
    uploads: dict[str, Upload] = {"whole": "full", "in short": "packed"}
    found = []
    for name, upload in uploads.items():
        f1 = [_f1(street, upload) for street in streets]
        detail = f"all voxels {np.mean([every for _, every in f1]):.2f}; {len(streets[0].results)} vehicles a street"
        found.append(Figure(f"map merged of reports {name}, F1", float(np.mean([s for s, _ in f1])), "%", detail))
    return found


def _f1(street: ReportStreet, upload: Upload) -> tuple[float, float]:
    merge = MergeParameters()
    held = arrived(street.base, street.results, merge, upload)
    merged = merged_map(street.base, [body for one in held for body in one.bodies], merge)
    scored = Scored.of(evaluate_maps(read_truth(street.files.truth), street.base.tiles, merged))
    return scored.f1("scored"), scored.f1("all")
