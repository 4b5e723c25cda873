"""Real short reports: what a few simulated drives along one street send, made once and kept in files."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import ChangeReport
from gnd.schemas.keys import change_key
from gnd.schemas.packed import PackedReport, decode_upload
from gnd.schemas.report_id import deterministic_report_id
from studies.frame.errors import ReproduceError
from studies.frame.folder import StudyFolder
from studies.simulation.base_map import BaseMap, read_base, write_base
from studies.simulation.result import VehicleResult, read_result
from studies.simulation.vehicle import VehicleTask, run_vehicle
from studies.simulation.worlds import WorldFiles, prepare_world, world_files
from studies.traffic_study.fleet import drive_config
from studies.traffic_study.options import TrafficOptions, street_of

FOLDER: Final = Path("runs/benchmark-short-reports")
SEED: Final = 205
LENGTH_M: Final = 100.0
DRIVES: Final = 2
_KEY: Final = "short-reports-2"


@dataclass(frozen=True, slots=True, eq=False)
class CorpusReport:
    """One report as its vehicle holds it: the first half in short, and whole."""

    packed: PackedReport
    whole: ChangeReport

    @property
    def key(self) -> str:
        """Where it is sent."""
        return change_key(self.whole.layer, self.whole.district)

    def of_vehicle(self, vehicle: str, number: int) -> "CorpusReport":
        """The same from another vehicle, under an id of its own."""
        report_id = deterministic_report_id(
            self.whole.first_ns // 1_000_000, vehicle, str(number), self.packed.report_id
        )
        return CorpusReport(
            replace(self.packed, report_id=report_id, vehicle=vehicle),
            replace(self.whole, report_id=report_id, vehicle=vehicle),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Corpus:
    """The map that the vehicles drove on, and what they report."""

    base: BaseMap
    reports: tuple[CorpusReport, ...]

    def tiles(self) -> list[Tile]:
        """The map as a store takes it."""
        return [Tile(tile, 1, gaussians) for tile, gaussians in self.base.tiles.items()]

    def bases(self) -> dict[bytes, Gaussians]:
        """The map by content hash, as the second half needs it."""
        return {self.base.shas[tile]: gaussians for tile, gaussians in self.base.tiles.items()}


def corpus(folder: Path = FOLDER, drives: int = DRIVES, length_m: float = LENGTH_M, scans: int | None = None) -> Corpus:
    """What `drives` vehicles report of one street; what is not in the folder yet is made, in about a minute a drive.

    Args:
        folder: keeps world and drives.
        drives: how many vehicles.
        length_m: of the street.
        scans: at most so many scans a drive; None: all of the street.

    Raises:
        ReproduceError: no drive has a report in short.
    """
    street = street_of("rebuilt", length_m)
    options = TrafficOptions(seed=SEED, street=street, drives=drives, base="surveyed", pcd_drives=0, scans=scans)
    files = world_files(StudyFolder.begun(folder), SEED, options.world)
    path = files.home / "map-standard.npz"
    if not path.is_file():
        prepare_world(files, SEED, options.world)
        tiles = read_base(files.base).tiles.items()
        write_base(BaseMap({tile: snap(gaussians, LATTICES["standard"]) for tile, gaussians in tiles}), path)
    results = [_driven(options, files, path, number) for number in range(drives)]
    reports = tuple(report for result in results for report in _short(result))
    if not reports:
        raise ReproduceError(f"{drives} drives of {length_m:g} m have no report in short; drive farther")
    return Corpus(read_base(path), reports)


def _driven(options: TrafficOptions, files: WorldFiles, base: Path, number: int) -> VehicleResult:
    drive = drive_config(options, number)
    key = f"{_KEY}-{drive.vehicle}-{options.scans}"
    result = files.home / "vehicles" / f"{key}.npz"
    if not result.is_file():
        task = VehicleTask(
            world=files.world,
            base=base,
            voxels=files.voxels,
            sensor=options.sensor,
            drive=drive,
            poses=options.poses,
            method=options.method,
            result=result,
            key=key,
        )
        run_vehicle(task, lambda *_: None)
    return read_result(result, key)


def _short(result: VehicleResult) -> Iterator[CorpusReport]:
    for body, packed in zip(result.reports, result.packed, strict=True):
        first = decode_upload(packed) if packed else None
        if isinstance(first, PackedReport):
            yield CorpusReport(first, ChangeReport.decode(body))
