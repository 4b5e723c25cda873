"""`gnd reproduce traffic`: what a map and its changes weigh on the way (GND paper, section 7.5 and Figure 23)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_sim.street import street
from gnd.gnd_map.codec import CODEC_FLOAT32, LATTICES
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from studies.frame.command import Bench, StudyReport, study
from studies.frame.pool import Job
from studies.pcd import PcdMap
from studies.simulation.base_map import read_base
from studies.simulation.worlds import WorldFiles, prepare_cloud, prepare_world, world_files
from studies.traffic_study.clouds import cloud_sizes, kept_cloud, points_by_tile
from studies.traffic_study.download import (
    DownloadTrack,
    Question,
    Server,
    along_drive,
    fetched_tiles,
    partly_changed,
    store_of,
)
from studies.traffic_study.fleet import DrivenWay, Fleet, TrafficFleet
from studies.traffic_study.options import TrafficOptions
from studies.traffic_study.quality import CodecMeasures, codec_measures, protobuf_bytes
from studies.traffic_study.summary import (
    PUBLISHED,
    RETURN_SHARE,
    DownloadOutcome,
    TrafficOutcome,
    summary_of,
    tables_of,
)

LINK: Final = "4g"


@study(TrafficOptions, out="runs/reproduce-traffic")
def traffic(options: TrafficOptions, bench: Bench) -> StudyReport:
    """What a map and its changes weigh on the way: Figure 23 of the GND paper, with our codecs.

    A second start with the same options and folder continues where the first ended.
    """
    files = world_files(bench.folder, options.seed, options.world)
    jobs = [Job("world", prepare_world, (files, options.seed, options.world))]
    jobs.append(Job("street as points", _cloud, (options, files)))
    if options.pcd_drives:
        jobs.append(Job("point cloud", prepare_cloud, (files, options.seed, options.world)))
    bench.run("world", jobs)
    with bench.timed("drives"):
        fleet, floats = _fleets(options, files, bench)
    jobs = [Job("download", download, (options, files, fleet)), Job("codecs", codecs_on_street, (options, files))]
    downloaded, codecs = bench.run("map and codecs", jobs)
    links = tuple(load_link(name) for name in ("3g", "4g", "5g"))
    found = summary_of(TrafficOutcome(options, downloaded, fleet, floats, codecs, links, bench.spent_s))

    def draw(folder: Path) -> None:
        from studies.traffic_study.figures import draw_figures

        draw_figures(found, folder)

    return StudyReport(found, tables_of(found), draw)


def _fleets(options: TrafficOptions, files: WorldFiles, bench: Bench) -> tuple[TrafficFleet, TrafficFleet | None]:
    """The fleet with our codecs, and its first drives once more with floats."""
    fleet = Fleet(options, files)
    ours = fleet.run(DrivenWay(PUBLISHED, LATTICES[PUBLISHED]), options.drives, bench)
    again = min(options.f1_drives, options.drives)
    return ours, fleet.run(DrivenWay("float", None), again, bench) if again else None


def codecs_on_street(options: TrafficOptions, files: WorldFiles) -> dict[str, CodecMeasures]:
    """Return the measures of the codecs on the study's street."""
    return codec_measures(street(options.seed, options.street), read_base(files.base).tiles, options.sensor_model)


def download(options: TrafficOptions, files: WorldFiles, fleet: TrafficFleet) -> DownloadOutcome:
    """Return what a vehicle downloads on the first drive, in all forms, and what it downloads when it comes back."""
    world, base = street(options.seed, options.street), read_base(files.base).tiles
    track, link = DownloadTrack.of(world, options), load_link(LINK)
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
    track: DownloadTrack, link: LinkProfile, path: Path, *states: Mapping[TileId, Gaussians], **how: Any
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
