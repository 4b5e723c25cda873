"""Our own rows: vehicles and cloud on the exported files, and the point-cloud baseline on the same scans and poses."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from rich.progress import Progress

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveItem, ReferencePose
from gnd.schemas.drive_mcap import drive_counts, read_drive, read_header
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.pipeline import Parts, Pipeline
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportList
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.benchmark.errors import BenchmarkError
from studies.benchmark.export import GIVEN, MARK, tiles_of
from studies.benchmark.files import read_cloud, read_json, sha_of
from studies.benchmark.frames import IndexFrame
from studies.benchmark.kit.score import SubmissionError, plain_name
from studies.frame.kept import Kept, key_of, sources_sha
from studies.frame.options import check, option
from studies.frame.pool import Job, Tick, run_jobs
from studies.pcd import PcdMap, PcdReport, gnd_of, merge_pcd, settled
from studies.simulation.base_map import BaseMap
from studies.simulation.baseline import CloudVehicle
from studies.simulation.cloud import map_of_one, merged_map
from studies.simulation.options import MethodParameters, Mode
from studies.simulation.poses import FromReference
from studies.simulation.streams import ticking
from studies.simulation.worlds import PCD, VEHICLE

Rules = Literal["default", "paper", "paper-observers", "points"]
Poses = Literal["own", "given"]
Tiles = Mapping[TileId, Gaussians]
Changes = tuple[I64, list[str]]
"""Voxels i, j, k, int64 (N, 3), and the class of each."""
MERGED: Final = "merged"
DRIVES: Final = "drives"
"""Folder of results of drives, beside the submissions."""
_GIVEN: Final = replace(GIVEN, kind="true")
"""The given poses are taken as they are, known to what the page says of them."""


@dataclass(frozen=True, slots=True)
class EntryOptions:
    """What makes a submission of ours."""

    rules: Rules = option(
        "default",
        "default: our vehicles and cloud; paper, paper-observers: the GND paper's; points: point-cloud baseline.",
    )
    poses: Poses = option("own", "own: the vehicle localises on the map; given: the poses of poses.csv.")
    vehicles: int | None = option(None, "Merge only the first so many vehicles.", span=(1, None))

    def __post_init__(self) -> None:
        check(self)

    @property
    def mode(self) -> Mode:
        """The rules of vehicle and cloud."""
        return "default" if self.rules == "points" else self.rules


@dataclass(frozen=True, slots=True)
class WorldFolder:
    """An exported world as our programs read it."""

    home: Path
    vehicles: tuple[str, ...]

    def drive(self, vehicle: str) -> Path:
        """The folder of a drive."""
        return self.home / "drives" / vehicle

    @property
    def frame(self) -> IndexFrame:
        """Its voxels."""
        return IndexFrame.read(self.home / "frame.json")

    def base(self) -> BaseMap:
        """Return the map before, from the store."""
        with SqliteStore(self.home / "map_before" / "store.sqlite", read_only=True) as store:
            return BaseMap({tile_id: tile.gaussians for tile_id, tile in tiles_of(store).items()})

    def cloud(self) -> PcdMap:
        """Return the map before as points."""
        return PcdMap(read_cloud(self.home / "map_before" / "points.pcd"), self.frame.grid.frame)


@dataclass(frozen=True, slots=True)
class DrivenReports:
    """The results of one drive: encoded reports of our vehicle, or the report of the point-cloud baseline."""

    bodies: tuple[bytes, ...]
    pcd: PcdReport | None


def run_entry(
    folder: Path, submission: Path, options: EntryOptions, processes: int, progress: Progress
) -> dict[str, Any]:
    """Run the vehicles that have not run yet, merge, and write the submission; returns how much it holds.

    Results of drives are kept in a folder beside the submission, so that a second start goes on where the first ended,
    and submissions that differ in the merge alone share them.

    Raises:
        BenchmarkError: the folder is no finished export, or the submission cannot be written.
    """
    mark = read_json(folder / MARK)
    if not mark.get("finished"):
        raise BenchmarkError(f"the export into {folder} has not ended: start it again, it goes on where it was")
    worlds = worlds_of(folder, mark)
    submission.parent.mkdir(parents=True, exist_ok=True)
    work = submission.parent / DRIVES
    drives = [(world, vehicle, kept_of(work, name, world, vehicle, options))
              for name, world in worlds.items() for vehicle in world.vehicles]  # fmt: skip
    jobs = [Job(f"{world.home.name}, {vehicle}", run_drive, (world, vehicle, kept, options), ticks=True)
            for world, vehicle, kept in drives if not kept.done]  # fmt: skip
    run_jobs(jobs, processes, progress, "drives")
    merges = [Job(name, changes_of_world, (world, [kept for w, _, kept in drives if w is world], options))
              for name, world in worlds.items()]  # fmt: skip
    found = dict(zip(worlds, run_jobs(merges, 1, progress, "merges"), strict=True))
    return write_submission(submission, found)


def worlds_of(folder: Path, mark: Mapping[str, Any]) -> dict[str, WorldFolder]:
    """The folders of the worlds that an export names.

    Raises:
        BenchmarkError: it names none, or one outside of itself.
    """
    try:
        named = {plain_name(one["name"]): tuple(map(plain_name, one["vehicles"])) for one in mark["worlds"]}
    except (SubmissionError, KeyError, TypeError) as error:
        raise BenchmarkError(f"{folder / MARK}: {error}") from error
    return {name: WorldFolder(folder / "worlds" / name, vehicles) for name, vehicles in named.items()}


def kept_of(work: Path, name: str, world: WorldFolder, vehicle: str, options: EntryOptions) -> Kept:
    """Return where a drive's result is kept, under a hash of everything that decides it."""
    drive = world.drive(vehicle)
    key = key_of(
        drive=sha_of(drive / "drive.mcap"),
        given=sha_of(drive / "poses.csv") if options.poses == "given" else None,
        map=sha_of(world.home / "map_before" / "gaussians.csv"),
        sources=sources_sha((*VEHICLE, "studies/benchmark/run.py")),
        rules=options.rules.removesuffix("-observers"),  # the vehicles are the same
        pcd=sources_sha(PCD) if options.rules == "points" else None,
    )
    return Kept(work, f"{name}-{vehicle}", key)


# --- one drive ------------------------------------------------------------------------------------------------------


def run_drive(world: WorldFolder, vehicle: str, kept: Kept, options: EntryOptions, tick: Tick) -> None:
    """Run our vehicle over a recorded drive, as the agent does, and keep what it reports."""
    path, method = world.drive(vehicle) / "drive.mcap", MethodParameters.of_mode(options.mode)
    header, base, outbox = read_header(path), world.base(), ReportList()
    fix, items = first_fix(_items(world.drive(vehicle), options), path)
    cloud: list[CloudVehicle] = []
    parts = Parts(
        localisation=(lambda local_map: FromReference(header, local_map, _GIVEN, 0))
        if options.poses == "given"
        else None,
        watch=(lambda segmented: cloud[0].add_scan(segmented) if cloud else None,),
    )
    pipeline = Pipeline(
        header,
        fix,
        lambda local_map, touched: TilesAtHand(base, local_map, touched),
        PipelineParameters(method.localise, method.segment, method.detect, method.report),
        identity=Identity(header.vehicle, header.drive_id, header.sensor_model, "ndt", "gnd benchmark"),
        outbox=outbox,
        parts=parts,
    )
    if options.rules == "points":
        cloud.append(CloudVehicle(world.cloud(), pipeline.local_map.grid_frame.frame))
    for item in ticking(items, tick, drive_counts(path).scans):
        pipeline.push(item)
    pipeline.finish()
    bodies = tuple(report.body for report in sorted(outbox.reports, key=lambda report: report.report_id))
    kept.write(DrivenReports(bodies, cloud[0].report()[0] if cloud else None))


def _items(drive: Path, options: EntryOptions) -> Iterator[DriveItem]:
    """What was recorded; with the given poses among it, in time order, where these are wanted."""
    poses = iter(read_poses(drive / "poses.csv") if options.poses == "given" else ())
    coming = next(poses, None)
    for item in read_drive(drive / "drive.mcap"):
        while coming is not None and coming.t_ns <= item.t_ns:
            yield coming
            coming = next(poses, None)
        yield item
    if coming is not None:
        yield coming
    yield from poses


def read_poses(path: Path) -> list[ReferencePose]:
    """Read the poses of a table of `gnd benchmark export`.

    Raises:
        BenchmarkError: it is missing or damaged.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines()[1:] if line.split("#")[0].strip()]
        if not lines:
            raise BenchmarkError(f"cannot read the poses {path}: there are none")
        t_ns = np.loadtxt(lines, np.int64, delimiter=",", usecols=0, ndmin=1)
        rows = np.loadtxt(lines, delimiter=",", usecols=range(1, 8), ndmin=2)
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"cannot read the poses {path}: {error}") from error
    T = [T_from_R_t(R, t) for R, t in zip(R_from_quaternion_xyzw(rows[:, 3:]), rows[:, :3], strict=True)]
    return [ReferencePose(int(t), one) for t, one in zip(t_ns, T, strict=True)]


# --- what became of the map -----------------------------------------------------------------------------------------


def changes_of_world(world: WorldFolder, kept: Sequence[Kept], options: EntryOptions) -> dict[str, Changes]:
    """Return the changes of a world by vehicle, and those of the merged map."""
    driven = [one.read(DrivenReports) for one in kept]
    together = driven[: options.vehicles]
    maps = _cloud_maps if options.rules == "points" else _gaussian_maps
    frame, base = world.frame, world.base()
    before, of_single, of_merged = maps(world, base, driven, together, options)
    finals = [*zip(world.vehicles, of_single, strict=True), (MERGED, of_merged)]
    return {who: changes_between(frame, base.tiles, before, after) for who, after in finals}


def _gaussian_maps(
    _world: WorldFolder,
    base: BaseMap,
    driven: Sequence[DrivenReports],
    together: Sequence[DrivenReports],
    options: EntryOptions,
) -> tuple[Tiles, list[Tiles], Tiles]:
    method = MethodParameters.of_mode(options.mode)
    single: list[Tiles] = [map_of_one(base, one.bodies, method.merge, method.parked_h) for one in driven]
    bodies = [body for one in together for body in one.bodies]
    return base.tiles, single, merged_map(base, bodies, method.merge, method.parked_h)


def _cloud_maps(
    world: WorldFolder,
    _base: BaseMap,
    driven: Sequence[DrivenReports],
    together: Sequence[DrivenReports],
    _options: EntryOptions,
) -> tuple[Tiles, list[Tiles], Tiles]:
    cloud, grid = world.cloud(), world.frame.grid

    def healed(reports: Iterable[DrivenReports]) -> Tiles:
        merged = merge_pcd(cloud, [one.pcd for one in reports if one.pcd is not None])
        return settled(before, gnd_of(merged, grid))

    before = gnd_of(cloud, grid)
    return before, [healed([one]) for one in driven], healed(together)


def changes_between(frame: IndexFrame, held: Tiles, before: Tiles, after: Tiles) -> Changes:
    """Return the changes from one map to another.

    Args:
        frame: of the world; voxels outside of it are left out.
        held: the map before that the scorer knows: what contradicts it is left out. (A map made of points holds some
            Gaussians more or less.)
        before: the one map.
        after: the other.
    """
    nothing, found = Gaussians.empty(), defaultdict(list)
    for tile_id in sorted(set(before) | set(after)):
        old, delta = before.get(tile_id, nothing), diff(before.get(tile_id, nothing), after.get(tile_id, nothing))
        known = held.get(tile_id, nothing).voxel_id
        put = delta.put.voxel_id
        by_class = {
            "new": np.setdiff1d(np.setdiff1d(put, old.voxel_id), known),
            "modified": np.intersect1d(np.intersect1d(put, old.voxel_id), known),
            "deleted": np.intersect1d(delta.removed, known),
        }
        for name, voxel_id in by_class.items():
            ijk = frame.ijk(np.full(len(voxel_id), tile_id.morton), voxel_id)
            found[name].append(ijk[frame.inside(ijk)])
    parts = {name: np.concatenate(many) for name, many in found.items()}
    names = [name for name, ijk in parts.items() for _ in range(len(ijk))]
    return (np.concatenate(list(parts.values())) if parts else np.zeros((0, 3), np.int64)), names


def write_submission(submission: Path, found: Mapping[str, Mapping[str, Changes]]) -> dict[str, Any]:
    """Write the submission; it appears complete or not at all."""
    lines, counts = ["world,vehicle,i,j,k,class"], {}
    for world, of_world in found.items():
        for who, (ijk, names) in of_world.items():
            lines += [f"{world},{who},{i},{j},{k},{name}" for (i, j, k), name in zip(ijk.tolist(), names, strict=True)]
            counts[f"{world}/{who}"] = len(names)
    partial = submission.with_name(f".{submission.name}.part")
    try:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
        partial.replace(submission)
    except OSError as error:
        raise BenchmarkError(f"cannot write {submission}: {error}") from error
    return {"submission": str(submission), "voxels": counts}
