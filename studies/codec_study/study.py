"""`gnd reproduce codec`: what tiles weigh and how far rounding moves poses, on recordings and simulated places."""

from dataclasses import MISSING, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import DELTA_CODECS, LATTICES, RANGE_CODECS, Codec, Lattice, codec_of, snap
from gnd.gnd_map.codec.range_tile import spent_by_field
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from studies.codec_scenes import registered_poses
from studies.codec_study.pictures import draw
from studies.codec_study.scenes import SOURCES, CodecScene, Maps, SceneSource, recorded, simulated
from studies.frame.command import Bench, StudyReport, study
from studies.frame.measure import core_s
from studies.frame.options import check, option, seeds
from studies.frame.scans import local_map_of
from studies.frame.tables import Sheet, sheet

FORMAT: Final = "gnd.codec-study"
OTHER_START_M: Final = 0.02
MUST_BYTES, MUST_CM = 4.0, 0.3
_RECORDINGS: Final = tuple(source.name for source in SOURCES)
Shifts = dict[str, float]


@dataclass(frozen=True, slots=True)
class CodecOptions:
    """What is measured."""

    recordings: Path = option(MISSING, "Folder with the recordings.")
    real: tuple[str, ...] = option(_RECORDINGS, "Of them only these.", known=_RECORDINGS, some=False)
    families: tuple[str, ...] = option(
        ("street", "suburb", "motorway", "roundabout"), "Simulated places.", known=FAMILY_NAMES, some=False
    )
    seeds: tuple[int, ...] = seeds(601, text="Of the simulated places; tables were learnt at 101.")

    def __post_init__(self) -> None:
        check(self)


@study(CodecOptions, out="runs/codec", jobs=1, marked=False)
def codec(options: CodecOptions, bench: Bench) -> StudyReport:
    """Bytes a voxel of each codec, by field, and how far apart poses lie that scans find on the map before and after.

    Real recordings and simulated places; those that the codec's tables were learnt from are marked. Beside the shift
    stands how far apart poses on the same, unrounded map are from starts 2 cm apart: less cannot be measured.
    """
    chosen = [source for source in SOURCES if source.name in options.real]
    makes = [partial(_recorded, source, options.recordings, bench) for source in chosen]
    makes += [partial(simulated, family, seed) for family in options.families for seed in options.seeds]
    scenes = {}
    for number, make in enumerate(makes):
        bench.step("scenes", number, len(makes))
        scene = make()
        scenes[scene.name] = measured(scene)
    bench.step("scenes", len(makes), len(makes))
    found = {"format": FORMAT, "version": 1, "must": {"bytes": MUST_BYTES, "p95_cm": MUST_CM}, "scenes": scenes}
    return StudyReport(found, [table_of(found)], partial(draw, found) if bench.pictures else None)


def _recorded(source: SceneSource, folder: Path, bench: Bench) -> CodecScene:
    return recorded(source, folder, lambda title, done, total: bench.step(f"{source.name}: {title}", done, total))


def measured(scene: CodecScene) -> dict[str, Any]:
    """Sizes, shifts and times of all codecs that look at neighbours on a scene, as plain values."""
    poses = registered_poses(local_map_of(scene.grid_frame, scene.tiles), scene.scans)
    found: dict[str, Any] = {
        "kind": scene.kind,
        "voxels": scene.voxels,
        "tiles": len(scene.tiles),
        "scans": sum(pose is not None for pose in poses),
        "same_map_cm": _quantiles(poses, _from_other_starts(scene)),
        "codecs": {},
    }
    for lattice in LATTICES.values():
        rounded = {tile_id: snap(g, lattice, new_map=True) for tile_id, g in scene.tiles.items()}
        shift = _quantiles(poses, registered_poses(local_map_of(scene.grid_frame, rounded), scene.scans))
        for one in map(codec_of, DELTA_CODECS):
            if one.lattice is lattice:
                found["codecs"][one.name] = {"id": one.codec_id} | _sizes(one, lattice, rounded) | {"shift_cm": shift}
    return found


def _from_other_starts(scene: CodecScene) -> list[F64 | None]:
    """The poses on the map as it is, from starts that are a little off."""
    moved = []
    for number, (points, T) in enumerate(scene.scans):
        start = T.copy()
        start[:2, 3] += OTHER_START_M * np.array([np.cos(number), np.sin(number)])
        moved.append((points, start))
    return registered_poses(local_map_of(scene.grid_frame, scene.tiles), moved)


def _quantiles(before: list[F64 | None], after: list[F64 | None]) -> Shifts:
    """Median and 95 % of the distances between poses, centimetres; NaN where no scan matches."""
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if a is not None and b is not None]
    cm = np.array([100.0 * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in pairs] or [np.nan])
    return {"p50": float(np.median(cm)), "p95": float(np.quantile(cm, 0.95))}


def _sizes(one: Codec, lattice: Lattice, tiles: Maps) -> dict[str, Any]:
    """Bytes a voxel, whole and, of the range codecs, by field; microseconds a voxel to write and to read, one core."""
    n, total, fields, sets = sum(map(len, tiles.values())), 0, dict[str, float](), list[int]()
    is_range = one.codec_id in RANGE_CODECS
    by_set = is_range and one.codec_id >= 8
    for tile_id, gaussians in tiles.items():
        body = one.encode(tile_id, gaussians)
        total += len(body)
        sets += [body[0]] if by_set else []
        spent_on = spent_by_field(tile_id, gaussians, lattice, body[0] if by_set else None) if is_range else {}
        for name, spent in spent_on.items():
            fields[name] = fields.get(name, 0.0) + spent / n
    tile_id, largest = max(tiles.items(), key=lambda item: len(item[1]))
    encode_us, decode_us = _times_us(one, tile_id, largest)
    return {
        "bytes": total / n,
        "fields": fields,
        "sets": np.bincount(sets).tolist() if sets else [],
        "encode_us": encode_us,
        "decode_us": decode_us,
    }


def _times_us(one: Codec, tile_id: TileId, gaussians: Gaussians) -> tuple[float, float]:
    """A voxel of a tile."""
    body = one.encode(tile_id, gaussians)
    encode_s, decode_s = core_s(lambda: one.encode(tile_id, gaussians)), core_s(lambda: one.decode(tile_id, body))
    return 1e6 * encode_s / len(gaussians), 1e6 * decode_s / len(gaussians)


def table_of(found: dict[str, Any]) -> Sheet:
    """One row a scene and codec."""
    table = sheet(
        "Codecs on real and simulated streets", "scene", "codec", "B/voxel", "voxels", "means", "cov.", "counts",
        "shift cm", "95 %", "write µs", "read µs",
    )  # fmt: skip
    for name, scene in found["scenes"].items():
        same = scene["same_map_cm"]
        table.add(
            f"{name}: {scene['kind']}", f"{scene['voxels']} voxels, {scene['scans']} scans", "", "", "", "", "",
            f"({same['p50']:.2f}", f"{same['p95']:.2f})", style="bold",
        )  # fmt: skip
        for codec_name, one in scene["codecs"].items():
            fields = one["fields"]
            parts = [f"{fields[x]:.2f}" if fields else "" for x in ("voxels", "means", "covariances", "counts")]
            shift = one["shift_cm"]
            table.add(
                "", codec_name, f"{one['bytes']:.2f}", *parts, f"{shift['p50']:.2f}", f"{shift['p95']:.2f}",
                f"{one['encode_us']:.1f}", f"{one['decode_us']:.1f}",
            )  # fmt: skip
    table.notes.append(
        f"In brackets: the same map, not rounded, from starts {100 * OTHER_START_M:.0f} cm apart. Must on real streets:"
        f" standard at most {MUST_BYTES} B a voxel with 95 % of the shifts within {MUST_CM} cm."
    )
    return table
