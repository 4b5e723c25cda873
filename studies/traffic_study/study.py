"""A traffic study from options to results: world, drives, maps on their way, codecs; what is kept is not made again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final

from rich.progress import Progress

from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_sim.street import street
from gnd.gnd_map.codec import CODEC_FLOAT32, LATTICES
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from studies.pcd import PcdMap
from studies.simulation.base_map import read_base
from studies.simulation.folder import RunFolder
from studies.simulation.pool import Job, run_jobs
from studies.simulation.worlds import WorldFiles, prepare_cloud, prepare_world, world_files
from studies.traffic_study.clouds import Written, cloud_sizes, kept_cloud, points_by_tile
from studies.traffic_study.download import (
    Question,
    Server,
    Track,
    along_drive,
    fetched_tiles,
    partly_changed,
    store_of,
)
from studies.traffic_study.fleet import Fleet, FleetOutcome, Way
from studies.traffic_study.options import TrafficOptions
from studies.traffic_study.quality import CodecMeasures, codec_measures, protobuf_bytes

PUBLISHED: Final = "standard"
"""The lattice of published maps."""
RETURN_SHARE: Final = 0.02
LINK: Final = "4g"


@dataclass(frozen=True, slots=True, eq=False)
class DownloadOutcome:
    """A map on its way.

    Attributes:
        track: the drive.
        voxels: Gaussians by tile fetched.
        gnd, gnd_float: questions and answers in our codecs, and in float32 columns.
        protobuf: bytes of the tiles as the paper writes them.
        clouds: bytes of the same tiles as a point cloud, by format, or why there are none.
        points: points of that cloud by tile.
        returned: questions of a vehicle that holds the map before a share of it changed.
        after_fleet: those of a vehicle that holds the map before the fleet's drives; with how many voxels have changed.
        changed_by_fleet: voxels.
    """

    track: Track
    voxels: Mapping[TileId, int]
    gnd: Sequence[Question]
    gnd_float: Sequence[Question]
    protobuf: int
    clouds: Mapping[str, Written]
    points: Mapping[TileId, int]
    returned: Sequence[Question]
    after_fleet: Sequence[Question]
    changed_by_fleet: int


@dataclass(frozen=True, slots=True, eq=False)
class StudyOutcome:
    """A finished study."""

    options: TrafficOptions
    download: DownloadOutcome
    fleet: FleetOutcome
    floats: FleetOutcome | None
    codecs: Mapping[str, CodecMeasures]
    links: tuple[LinkProfile, ...]
    runtime_s: Mapping[str, float]


def study(options: TrafficOptions, folder: RunFolder, processes: int, progress: Progress) -> StudyOutcome:
    """Run everything that is not yet in the folder.

    Args:
        options: what to run.
        folder: keeps the world and the drives for the next start.
        processes: worker processes.
        progress: gets the bars.

    Raises:
        GndError: something cannot be made as asked.
    """
    started_s = perf_counter()
    files = world_files(folder, options.seed, options.world)
    jobs = [Job("world", prepare_world, (files, options.seed, options.world))]
    jobs.append(Job("street as points", _cloud, (options, files)))
    if options.pcd_drives:
        jobs.append(Job("point cloud", prepare_cloud, (files, options.seed, options.world)))
    run_jobs(jobs, processes, progress, "world")
    world_s = perf_counter()
    fleet, floats = _fleets(options, files, processes, progress)
    fleet_s = perf_counter()
    jobs = [
        Job("download", download, (options, files, fleet)),
        Job("codecs", codecs_on_street, (options, files)),
    ]
    downloaded, codecs = run_jobs(jobs, processes, progress, "map and codecs")
    spent = {"world": world_s - started_s, "drives": fleet_s - world_s, "map and codecs": perf_counter() - fleet_s}
    links = tuple(load_link(name) for name in ("3g", "4g", "5g"))
    return StudyOutcome(options, downloaded, fleet, floats, codecs, links, spent)


def _fleets(
    options: TrafficOptions, files: WorldFiles, processes: int, progress: Progress
) -> tuple[FleetOutcome, FleetOutcome | None]:
    """The fleet with our codecs, and its first drives once more with floats."""
    fleet = Fleet(options, files)
    ours = fleet.run(Way(PUBLISHED, LATTICES[PUBLISHED]), options.drives, processes, progress)
    again = min(options.f1_drives, options.drives)
    return ours, fleet.run(Way("float", None), again, processes, progress) if again else None


def codecs_on_street(options: TrafficOptions, files: WorldFiles) -> dict[str, CodecMeasures]:
    """Return the measures of the codecs on the study's street."""
    return codec_measures(street(options.seed, options.street), read_base(files.base).tiles, options.sensor_model)


def download(options: TrafficOptions, files: WorldFiles, fleet: FleetOutcome) -> DownloadOutcome:
    """Return what a vehicle downloads on the first drive, in all forms, and what it downloads when it comes back."""
    world, base = street(options.seed, options.street), read_base(files.base).tiles
    track, link = Track.of(world, options), load_link(LINK)
    published = fleet.base.tiles
    changed = partly_changed(published, RETURN_SHARE, options.seed)
    held = {tile: Tile(tile, 1, gaussians) for tile, gaussians in published.items()}
    ours = _drive(track, link, files.home / "maps.sqlite", published)
    floats = _drive(track, link, files.home / "maps.sqlite", base, codecs=(CODEC_FLOAT32,))
    returned = _drive(track, link, files.home / "maps.sqlite", published, changed, held=held)
    after = _drive(track, link, files.home / "maps.sqlite", published, fleet.final.tiles, held=held)
    tiles = [tile for tile in fetched_tiles(ours) if tile in base]
    points = points_by_tile(_cloud(options, files), tiles)
    return DownloadOutcome(
        track=track,
        voxels={tile: len(base[tile]) for tile in tiles},
        gnd=ours,
        gnd_float=floats,
        protobuf=protobuf_bytes({tile: base[tile] for tile in tiles}),
        clouds=cloud_sizes(points),
        points={tile: len(one) for tile, one in points.items()},
        returned=returned,
        after_fleet=after,
        changed_by_fleet=sum(_differing(published[tile], fleet.final.tiles[tile]) for tile in tiles),
    )


def _cloud(options: TrafficOptions, files: WorldFiles) -> PcdMap:
    """The street as a point cloud; made when it is asked for first."""
    path = files.home / f"street-cloud-{options.base}.npz"
    return kept_cloud(street(options.seed, options.street), options.base, path)


def _drive(
    track: Track, link: LinkProfile, path: Path, *states: Mapping[TileId, Gaussians], **how: Any
) -> list[Question]:
    """The questions of a drive to a tile server that holds these states, the oldest first."""
    store = store_of(path, *states)
    try:
        return along_drive(track, Server(store), link, **how)
    finally:
        store.close()


def _differing(before: Gaussians, after: Gaussians) -> int:
    """How many voxels hold another Gaussian, or one in only one of two states."""
    delta = diff(before, after)
    return len(delta.removed) + len(delta.put)
