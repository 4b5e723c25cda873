"""What one vehicle makes of an unchanged world, through both gates: `python -m studies.real_gate --scans FOLDER`.

A recording of real scans, at its reference poses or at those of the vehicle's own localiser. Part of it makes the map,
the rest is driven, reported as an agent reports and merged as the cloud merges. Nothing has changed, so whatever is
published is wrong. Told apart is what lies where the map's half had looked: where its own rays say that a voxel holds
something or is empty. Of the rest the map cannot know.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.importer import no_progress, open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL
from gnd.vehicle_agent.importers.splits import chosen_scans
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.gated_merge import Merged, merged
from studies.real.drive import Poses, Tiles, detect, local_map_of, refined_scans, segmented
from studies.real.scene import RecordedScene, in_range, keys_of, load, place

I64 = NDArray[np.int64]
SIGMA_M, SIGMA_RAD = 0.02, 0.001
"""What reference poses say about themselves."""


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """A recording cut in two: the map of one half and the scans of the other, in a scene; `seen` (K,) keys of the
    voxels of which the map's own rays make a statement.
    """

    scene: RecordedScene
    tiles: Tiles
    local_map: LocalMap
    driving: Sequence[Scan]
    seen: I64


def halves_of(folder: Path, map_scans: str, drive_scans: str, at_most: int) -> Halves:
    """Read a recording, make the map of one part."""
    kind = format_of(folder)
    recording = open_recording(kind, folder, NOMINAL if kind == "pcd" else None, None)
    scene = place(load(recording, at_most, no_progress), 0)
    mapping, driving = ([scene.scans[i] for i in chosen_scans(rule, len(scene))] for rule in (map_scans, drive_scans))
    mapped = list(segmented(map(scene.refined, mapping), SegmentParameters()))
    points = VoxelAccumulator(scene.grid_frame)
    for one in mapped:
        points.add(one.scan.points_map_m[in_range(one.scan) & ~one.moving])
    tiles = {tile: snap(found, LATTICES["standard"]) for tile, found in points.finish(N_MIN_CELLS).items()}
    local_map = local_map_of(scene, tiles)
    looked = detect(scene, local_map, mapped, DetectParameters())
    return Halves(scene, tiles, local_map, driving, looked.keys[looked.change_class != ChangeClass.UNMEASURED])


def reported(halves: Halves, poses: Poses, folder: Path, *, check_poses: bool) -> tuple[Reporter, list[bytes]]:
    """The reporter after the drive, and its reports."""
    outbox = Outbox(folder / "outbox.sqlite")
    who = Identity("car", "drive", "HDL-64E", "ndt")
    detector, parameters = ChangeDetector(halves.local_map), ReportParameters(check_poses=check_poses)
    reporter = Reporter(detector, outbox, who, halves.driving[0].t_ns, parameters)
    scans = refined_scans(halves.scene, halves.local_map, halves.driving, poses)
    for k, one in enumerate(segmented(scans, SegmentParameters())):
        reporter.add_scan(_known(one) if poses == "reference" else one)
        reporter.leave_behind(one.scan.estimate, float(k))
    reporter.report_all(float(len(halves.driving)))
    return reporter, [letter.body for letter in outbox.due(0, limit=10_000)]


def _known(one: SegmentedScan) -> SegmentedScan:
    pose = replace(one.scan.estimate, sigma_m=SIGMA_M, sigma_rad=SIGMA_RAD)
    return SegmentedScan(replace(one.scan, estimate=pose), one.moving)


def counted(halves: Halves, changes: Sequence[TileChange], found: Merged, *, only_seen: bool) -> dict[str, Any]:
    """Observed, reported and published voxels of all changes, or only of what the map's half had seen."""
    observed, said, out = 0, Counter[str](), Counter[str]()
    for change in changes:
        known = _known_voxels(halves, change.tile, change.observed, only_seen=only_seen)
        observed += int(known.sum())
        of_changed = _known_voxels(halves, change.tile, change.changed.voxel_id, only_seen=only_seen)
        names = [ChangeClass(int(c)).name.lower() for c in change.change_class[of_changed]]
        said.update(names)
        voxels = change.changed.voxel_id[of_changed].tolist()
        out.update(name for name, v in zip(names, voxels, strict=True) if v in found.published.get(change.tile, ()))
    rates = {name: round(1e3 * n.total() / max(observed, 1), 3) for name, n in (("reported", said), ("published", out))}
    return {"observed": observed, "reported": dict(said), "published": dict(out), "of_1000": rates}


def _known_voxels(halves: Halves, tile: TileId, voxel_id: NDArray[np.int32], *, only_seen: bool) -> NDArray[np.bool_]:
    if not only_seen:
        return np.ones(len(voxel_id), np.bool_)
    frame = halves.scene.grid_frame
    return np.isin(keys_of(frame, frame.grid_of_voxel(tile, voxel_id)), halves.seen)


def run(folder: Path, map_scans: str, drive_scans: str, at_most: int, poses: Poses) -> dict[str, Any]:
    """All figures of one recording."""
    halves = halves_of(folder, map_scans, drive_scans, at_most)
    with tempfile.TemporaryDirectory() as where:
        reporter, bodies = reported(halves, poses, Path(where), check_poses=True)
        changes = [change for body in bodies for change in ChangeReport.decode(body).tiles]
        found = merged(halves.tiles, bodies)
    return {
        "recording": folder.name,
        "map_scans": map_scans,
        "drive_scans": drive_scans,
        "poses": poses,
        "scans": len(halves.driving),
        "scans_taken_back": reporter.counts["scans_shifted"] + reporter.counts["scans_taken_back"],
        "tiles_held_back": reporter.counts["tiles_held_back"],
        "doubts": dict(reporter.doubts),
        "all": counted(halves, changes, found, only_seen=False),
        "seen": counted(halves, changes, found, only_seen=True),
        "waiting": dict(found.waiting),
    }


def main() -> None:
    """Print the figures as JSON, a line a recording."""
    parser = argparse.ArgumentParser(prog="python -m studies.real_gate", description=__doc__)
    parser.add_argument("--scans", type=Path, nargs="+", required=True)
    parser.add_argument("--map-scans", default="first-half")
    parser.add_argument("--drive-scans", default="second-half")
    parser.add_argument("--first", type=int, default=200, help="at most so many scans are read")
    parser.add_argument("--poses", choices=("reference", "estimated"), default="reference")
    given = parser.parse_args()
    for folder in given.scans:
        print(json.dumps(run(folder, given.map_scans, given.drive_scans, given.first, given.poses)), flush=True)


if __name__ == "__main__":
    main()
