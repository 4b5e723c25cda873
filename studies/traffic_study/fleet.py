"""The drives of a study, one after the other through the same cloud: what each uploads, what map comes of it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig
from gnd.fleet_sim.evaluate import evaluate_maps
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.truth import LEVELS, Level, Truth, read_truth
from gnd.gnd_map.codec import Lattice, snap
from gnd.gnd_map.config import to_mapping
from studies.frame.command import Bench
from studies.frame.kept import SIMULATOR, key_of, sources_sha
from studies.frame.pool import run_jobs
from studies.simulation.base_map import BaseMap, read_base, write_base
from studies.simulation.result import VehicleResult, read_result
from studies.simulation.scores import Scored
from studies.simulation.study import drive_jobs
from studies.simulation.vehicle import VehicleTask
from studies.simulation.worlds import PCD, VEHICLE, WorldFiles
from studies.traffic_study.options import TrafficOptions
from studies.traffic_study.uploads import DriveUpload, UploadCloud, upload

_HOUR_NS = 3_600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class DrivenWay:
    """How maps and reports travel.

    Attributes:
        name: of its files.
        lattice: on which the published map lies; None: it stays as it was measured, and reports go whole, in floats.
    """

    name: str
    lattice: Lattice | None


@dataclass(frozen=True, slots=True, eq=False)
class TrafficFleet:
    """What came of the drives.

    Attributes:
        uploads: of each drive, in order.
        base: the map that the first vehicles drove with.
        final: the map after the last drive.
        f1: macro F1 in percent by level after `scored_after` drives, and after all (`final_f1`), of the stale map
            (`stale_f1`).
        published: new tile versions after each round.
    """

    uploads: tuple[DriveUpload, ...]
    base: BaseMap
    final: BaseMap
    stale_f1: dict[Level, float]
    f1: dict[Level, float]
    final_f1: dict[Level, float]
    published: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Fleet:
    """The drives of one study on one world."""

    options: TrafficOptions
    files: WorldFiles

    def run(self, way: DrivenWay, drives: int, bench: Bench) -> TrafficFleet:
        """Drive and merge, `options.at_once` vehicles at a time; drives whose results are kept are not driven again.

        Args:
            way: how maps and reports travel.
            drives: how many.
            bench: the processes.

        Raises:
            GndError: something cannot be made as asked, or an upload did not get through.
        """
        truth = read_truth(self.files.truth)
        base = _published(read_base(self.files.base), way.lattice)
        uploads: list[DriveUpload] = []
        published: list[int] = []
        scores: dict[int, dict[Level, float]] = {}
        store, merge = self.files.home / f"cloud-{way.name}.sqlite", self.options.method.merge
        with UploadCloud(store, base, merge, way.lattice.name if way.lattice else "float") as cloud:
            for first in range(0, drives, self.options.at_once):
                held = cloud.map()
                numbers = range(first, min(first + self.options.at_once, drives))
                driven = self._driven(way, held, numbers, bench)
                uploads += [upload(result, held, cloud) for result in driven]
                published.append(cloud.merge())
                scores[len(uploads)] = _f1(truth, base, cloud.map())
            final = cloud.map()
        after = min((n for n in scores if n >= self.options.f1_drives), default=drives)
        stale = _f1(truth, base, base)
        return TrafficFleet(tuple(uploads), base, final, stale, scores[after], scores[drives], tuple(published))

    def _driven(self, way: DrivenWay, held: BaseMap, numbers: range, bench: Bench) -> Iterator[VehicleResult]:
        """The results of drives that begin with the map `held`, in order."""
        path = self.files.home / f"map-{way.name}-{numbers.start:02d}.npz"
        write_base(held, path)
        tasks = [self._task(way, held, path, number) for number in numbers]
        title = f"drives {numbers.start + 1} to {numbers.stop}, {way.name}"
        run_jobs(drive_jobs(tasks), bench.processes, bench.progress, title)
        return (read_result(task.result, task.key) for task in tasks)

    def _task(self, way: DrivenWay, held: BaseMap, path: Path, number: int) -> VehicleTask:
        options, drive = self.options, drive_config(self.options, number)
        cloud = self.files.cloud if way.lattice is not None and number < options.pcd_drives else None
        key = self._key(way, held, drive, with_pcd=cloud is not None)
        return VehicleTask(
            world=self.files.world,
            base=path,
            voxels=self.files.voxels,
            sensor=options.sensor,
            drive=drive,
            poses=options.poses,
            method=_method(options, way),
            result=self.files.home / "vehicles" / f"{drive.vehicle}-{way.name}-{key}.npz",
            key=key,
            cloud=cloud,
            rounded=way.lattice is not None,
        )

    def _key(self, way: DrivenWay, held: BaseMap, drive: DriveConfig, *, with_pcd: bool) -> str:
        """A hash of everything that decides what the vehicle reports."""
        method: Any = to_mapping(_method(self.options, way))
        return key_of(
            sources=sources_sha(VEHICLE),
            truth=sources_sha(SIMULATOR),
            world=self.files.home.name,
            base=held.sha,
            versions=sorted((tile.morton, held.version(tile)) for tile in held.tiles),
            drive=to_mapping(drive),
            poses=str(self.options.poses),
            rounded=way.lattice is not None,
            pcd=sources_sha(PCD) if with_pcd else None,
            method={name: method[name] for name in ("localise", "segment", "detect", "report")},
        )


def drive_config(options: TrafficOptions, number: int) -> DriveConfig:
    """Return the drive of a number, 0 the first: directions alternate, cars and traffic are others each time."""
    return DriveConfig(
        vehicle=f"vehicle-{number:02d}",
        sensor=options.sensor_model,
        direction=1 if number % 2 == 0 else -1,
        seed=1_000_003 * options.seed + number,
        car_share=options.parking,
        traffic=Traffic.urban() if options.traffic else Traffic(),
        scans=options.scans,
        start_ns=EPOCH_NS + number * _HOUR_NS,
    )


def _method(options: TrafficOptions, way: DrivenWay) -> Any:
    """The parameters; floats go whole."""
    if way.lattice is not None:
        return options.method
    return replace(options.method, report=replace(options.method.report, protocol="full"))


def _published(base: BaseMap, lattice: Lattice | None) -> BaseMap:
    if lattice is None:
        return base
    return BaseMap({tile: snap(gaussians, lattice, new_map=True) for tile, gaussians in base.tiles.items()})


def _f1(truth: Truth, base: BaseMap, final: BaseMap) -> dict[Level, float]:
    scored = Scored.of(evaluate_maps(truth, base.tiles, final.tiles))
    return {level: scored.f1(level) for level in LEVELS}
