"""A finished study: plain values (the JSON of `gnd reproduce traffic`), the papers' results, our targets, tables."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any, Final

from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.gnd_map.config import to_mapping
from gnd.gnd_map.tile_id import TileId
from studies.frame.command import plain_options
from studies.frame.tables import Sheet, sheet, sheet_of
from studies.frame.targets import Target, judged, targets_sheet
from studies.traffic_study.clouds import Written
from studies.traffic_study.download import DownloadTrack, Question, fetched_tiles, total_bytes
from studies.traffic_study.fleet import TrafficFleet
from studies.traffic_study.options import TrafficOptions
from studies.traffic_study.quality import CodecMeasures
from studies.traffic_study.uploads import PARTS, DriveUpload

PAPER_KM: Final = 0.11e6 / 56.32e3
"""Way of one drive of the GND paper, km: 0.11 MB uploaded at 56.32 kB/km (sections 7.5 and 8)."""
PAPER_DRIVES: Final = 38
PAPER_BYTES: Final = {
    "download.pcd": 19.37e6,
    "download.gnd": 3.36e6,
    "upload.single.pcd_changes": 2.06e6,
    "upload.single.gnd": 0.11e6,
    "upload.fleet.raw": 1713e6,
    "upload.fleet.pcd_changes": 89.24e6,
    "upload.fleet.gnd": 3.511e6,
}
"""GND paper, section 7.5 and Figure 23."""

TARGETS: Final = (
    Target("bytes a voxel, standard", "codec.bytes_per_voxel", "B", "48 to 84", 4.6, 4.0),
    Target("pose shift, standard", "codec.pose_shift_cm_median", "cm", "", 0.15, 0.15),
    Target("bytes a voxel, compact", "codec.compact.bytes_per_voxel", "B", "", 3.0, 3.0),
    Target("pose shift, compact", "codec.compact.pose_shift_cm_median", "cm", "", 0.2, 0.2),
    Target("download, PCD to GND", "ratio.pcd", "x", "5.8", 60.0, 90.0, larger=True),
    Target("download, LAZ to GND", "ratio.laz", "x", "", 12.0, 16.0, larger=True),
    Target("upload, first sighting", "upload.kB_per_km.first", "kB/km", "56.32", 10.0, 3.0),
    Target("upload, first 8 drives", "upload.kB_per_km.flags_first", "kB/km", "56.32", 10.0, 1.5),
    Target("upload, steady state", "upload.kB_per_km.steady", "kB/km", "", 1.0, 0.3),
    Target("return download, 2 % changed", "download.return_bytes_per_tile", "B/tile", "", 150.0, 70.0),
    Target("F1 lost by the codec", "ratio.f1_loss", "points", "", 0.2, 0.0),
    Target("encode a tile", "codec.encode_ms", "ms", "", 10.0, 10.0),
    Target("decode a tile", "codec.decode_ms", "ms", "", 10.0, 10.0),
)


def targets_of(found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each row that this study can judge."""
    return judged({**found, "ratio": _ratios(found)}, TARGETS)


def _ratios(found: Mapping[str, Any]) -> dict[str, float | None]:
    """How many times larger the point clouds are, and what F1 the codec costs."""
    ours, f1 = found["download"]["gnd"]["bytes"], found["f1"]
    ratios: dict[str, float | None] = {
        name: found["download"][name]["bytes"] / ours if found["download"][name]["bytes"] else None
        for name in ("pcd", "laz")
    }
    return ratios | {"f1_loss": None if f1["float"] is None else f1["float"] - f1["codec"]}


PUBLISHED: Final = "standard"
"""The lattice of published maps."""
RETURN_SHARE: Final = 0.02


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

    track: DownloadTrack
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
class TrafficOutcome:
    """A finished study."""

    options: TrafficOptions
    download: DownloadOutcome
    fleet: TrafficFleet
    floats: TrafficFleet | None
    codecs: Mapping[str, CodecMeasures]
    links: tuple[LinkProfile, ...]
    runtime_s: Mapping[str, float]


FIRST_DRIVES: Final = 8
"""`flags_first` is the mean over so many drives."""


def summary_of(outcome: TrafficOutcome) -> dict[str, Any]:
    """Return everything as plain values."""
    found: dict[str, Any] = {
        "seed": outcome.options.seed,
        "street": {**to_mapping(outcome.options.street), "parking": outcome.options.parking},
        "km": round(outcome.download.track.km, 4),
        "download": _download(outcome.download),
        "upload": _upload(outcome.fleet.uploads, outcome.options.pcd_drives),
        "codec": _codec(outcome),
        "f1": _f1(outcome),
        "links": {link.name: _capacity(link, outcome.download.track.t_s[-1]) for link in outcome.links},
    }
    found["targets"] = targets_of(found)
    found["drives"] = [_drive(upload) for upload in outcome.fleet.uploads]
    found["parameters"] = _parameters(outcome)
    found["runtime_s"] = {name: round(value, 1) for name, value in outcome.runtime_s.items()}
    return found


def _download(found: DownloadOutcome) -> dict[str, Any]:
    voxels, tiles = sum(found.voxels.values()), len(found.voxels)
    sizes: dict[str, Any] = {
        name: {"bytes": size} if isinstance(size, int) else {"bytes": None, "missing": size}
        for name, size in found.clouds.items()
    }
    return {
        **sizes,
        "gnd_protobuf": {"bytes": found.protobuf},
        "gnd_float": _asked(found.gnd_float),
        "gnd": _asked(found.gnd),
        "km": round(found.track.km, 4),
        "tiles": tiles,
        "voxels": voxels,
        "voxels_per_km": round(voxels / found.track.km),
        "points": sum(found.points.values()),
        "return_bytes_per_tile": _per_tile(found.returned),
        "return": {**_asked(found.returned), "changed_share": RETURN_SHARE},
        "after_fleet": {
            **_asked(found.after_fleet),
            "bytes_per_tile": _per_tile(found.after_fleet),
            "changed_voxels": found.changed_by_fleet,
            "changed_share": round(found.changed_by_fleet / max(voxels, 1), 5),
        },
        "along": {"gnd": _along(found.gnd), "gnd_float": _along(found.gnd_float), "pcd": _along_cloud(found)},
    }


def _asked(questions: Sequence[Question]) -> dict[str, int]:
    return {
        "bytes": total_bytes(questions),
        "up_bytes": sum(question.up_bytes for question in questions),
        "down_bytes": sum(question.down_bytes for question in questions),
        "messages": len(questions),
        "wire_bytes": total_bytes(questions) + len(questions) * MESSAGE_OVERHEAD_BYTES,
    }


def _per_tile(questions: Sequence[Question]) -> float:
    return round(total_bytes(questions) / max(len(fetched_tiles(questions)), 1), 2)


def _along(questions: Sequence[Question]) -> list[list[float]]:
    """[time s, way m, bytes so far] after each answer."""
    rows, total = [], 0
    for question in questions:
        total += question.up_bytes + question.down_bytes
        rows.append([round(question.t_s, 2), round(question.way_m, 1), total])
    return rows


def _along_cloud(found: DownloadOutcome) -> list[list[float]]:
    """The same for the point cloud, tile by tile when ours are fetched: its points' share of the file."""
    size = found.clouds["pcd"]
    each = size / max(sum(found.points.values()), 1) if isinstance(size, int) else 0.0
    rows, total = [], 0.0
    for question in found.gnd:
        total += each * sum(found.points.get(tile, 0) for tile in question.fetched)
        rows.append([round(question.t_s, 2), round(question.way_m, 1), round(total)])
    return rows


def _upload(uploads: Sequence[DriveUpload], pcd_drives: int) -> dict[str, Any]:
    first, steady = uploads[0], uploads[len(uploads) // 2 :]
    with_pcd = [upload for upload in uploads[:pcd_drives] if upload.pcd_bytes]
    return {
        "single": _sizes([first]),
        "fleet": {**_sizes(uploads), "pcd_changes": _pcd_of_all(with_pcd, len(uploads))},
        "drives": len(uploads),
        "pcd_drives": len(with_pcd),
        "pcd_single": dict(first.pcd_bytes),
        "kB_per_km": {
            "first": _rate([first]),
            "flags_first": _rate(uploads[:FIRST_DRIVES]),
            "steady": _rate(steady),
            "first_float": round(first.float_bytes / first.km / 1e3, 4),
        },
        "wire_kB_per_km": {
            "first": _rate([first], "wire_bytes"),
            "flags_first": _rate(uploads[:FIRST_DRIVES], "wire_bytes"),
            "steady": _rate(steady, "wire_bytes"),
        },
        "changed_per_km": _densities(uploads, "changed"),
        "wanted_per_km": _densities(uploads, "wanted"),
        "observed_per_km": _density([first], "observed"),
        "parts_bytes_per_km": {
            "first": _parts([first]),
            "flags_first": _parts(uploads[:FIRST_DRIVES]),
            "steady": _parts(steady),
        },
        "steady_drives": len(steady),
        "message_overhead_bytes": MESSAGE_OVERHEAD_BYTES,
    }


def _sizes(uploads: Sequence[DriveUpload]) -> dict[str, Any]:
    pcd = [upload.pcd_bytes.get("points") for upload in uploads]
    return {
        "raw": {"bytes": sum(upload.raw_bytes for upload in uploads)},
        "pcd_changes": {"bytes": None if None in pcd else sum(size for size in pcd if size is not None)},
        "gnd_float": {
            "bytes": sum(upload.float_bytes for upload in uploads),
            "bitmap_bytes": sum(upload.bitmap_bytes for upload in uploads),
        },
        "gnd": {
            "bytes": sum(upload.bytes for upload in uploads),
            "wire_bytes": sum(upload.wire_bytes for upload in uploads),
            "messages": sum(upload.messages for upload in uploads),
        },
    }


def _pcd_of_all(with_pcd: Sequence[DriveUpload], drives: int) -> dict[str, Any]:
    """The baseline's map is not updated between the drives, so all weigh alike: the mean of those that were made."""
    if not with_pcd:
        return {"bytes": None}
    mean = fmean(upload.pcd_bytes["points"] for upload in with_pcd)
    return {"bytes": round(drives * mean), "mean_of_drives": len(with_pcd)}


def _rate(uploads: Sequence[DriveUpload], what: str = "bytes") -> float:
    """KB a km over all these drives."""
    return round(float(sum(getattr(upload, what) for upload in uploads)) / _km(uploads) / 1e3, 4)


def _densities(uploads: Sequence[DriveUpload], what: str) -> dict[str, float]:
    """By stage, a km."""
    stages = {"first": uploads[:1], "flags_first": uploads[:FIRST_DRIVES], "steady": uploads[len(uploads) // 2 :]}
    return {stage: _density(some, what) for stage, some in stages.items()}


def _density(uploads: Sequence[DriveUpload], what: str) -> float:
    return round(float(sum(getattr(upload, what) for upload in uploads)) / _km(uploads), 1)


def _parts(uploads: Sequence[DriveUpload]) -> dict[str, float]:
    return {part: round(sum(upload.parts[part] for upload in uploads) / _km(uploads), 1) for part in PARTS}


def _km(uploads: Sequence[DriveUpload]) -> float:
    return sum(upload.km for upload in uploads)


def _codec(outcome: TrafficOutcome) -> dict[str, Any]:
    measures = {name: _rounded(asdict(one)) for name, one in outcome.codecs.items()}
    return {**measures[PUBLISHED], **{name: one for name, one in measures.items() if name != PUBLISHED}}


def _f1(outcome: TrafficOutcome) -> dict[str, Any]:
    fleet, floats, drives = outcome.fleet, outcome.floats, len(outcome.fleet.uploads)
    return {
        "drives": min(outcome.options.f1_drives, drives),
        "stale": fleet.stale_f1["scored"],
        "codec": fleet.f1["scored"],
        "float": floats.f1["scored"] if floats else None,
        "all_drives": fleet.final_f1["scored"],
        "levels": {"codec": fleet.f1, "float": floats.f1 if floats else None, "all_drives": fleet.final_f1},
    }


def _capacity(link: LinkProfile, seconds: float) -> dict[str, float]:
    return {
        "down_bytes": round(link.rate_byte_s("down") * seconds),
        "up_bytes": round(link.rate_byte_s("up") * seconds),
        "seconds": round(float(seconds), 2),
    }


def _drive(upload: DriveUpload) -> dict[str, Any]:
    return {**asdict(upload), "km": round(upload.km, 4), "bytes": upload.bytes, "wire_bytes": upload.wire_bytes}


def _parameters(outcome: TrafficOutcome) -> dict[str, Any]:
    world = plain_options(outcome.options.world)
    return {
        **{name: value for name, value in to_mapping(outcome.options).items() if name not in ("method", "poses")},
        "poses": world["poses"],
        "method": world["method"],
    }


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in values.items()}


MAPS = (
    ("pcd", "PCD, 0.2 m"),
    ("laz", "LAZ, 1 cm"),
    ("draco", "Draco, 12 bits"),
    ("gnd_protobuf", "GND, protobuf of doubles"),
    ("gnd_float", "GND, float32 columns"),
    ("gnd", "GND, standard"),
)
UPLOADS = (
    ("raw", "all measurements"),
    ("pcd_changes", "point-cloud changes"),
    ("gnd_float", "GND changes in floats"),
    ("gnd", "GND changes, flags first"),
)
STAGES = (("first", "first drive"), ("flags_first", "first 8 drives"), ("steady", "merged world"))


def tables_of(found: Mapping[str, Any]) -> list[Sheet]:
    """Return all tables."""
    return [_maps(found), _uploads(found), _rates(found), _codecs(found), _targets(found)]


def _maps(found: Mapping[str, Any]) -> Sheet:
    down = found["download"]
    title = (
        f"download along {found['km']:.3f} km: {down['tiles']} tiles, {down['voxels']} voxels"
        f" ({down['voxels_per_km']} a km), {down['points']} points"
    )
    table = sheet(title, "map", "MB", "MB/km", "B a voxel", "times GND", "paper, MB/km")
    for name, label in MAPS:
        size = down[name]["bytes"]
        if size is None:
            table.add(label, down[name]["missing"], "", "", "", "")
            continue
        ratio, paper = size / down["gnd"]["bytes"], PAPER_BYTES.get(f"download.{name}")
        shown = "" if paper is None else f"{paper / 1e6 / PAPER_KM:.2f}"
        row = (f"{size / 1e6:.3f}", f"{size / 1e6 / found['km']:.3f}", f"{size / down['voxels']:.2f}", f"{ratio:.1f}")
        table.add(label, *row, shown)
    return table


def _uploads(found: Mapping[str, Any]) -> Sheet:
    up = found["upload"]
    rate = up["changed_per_km"]["first"]
    title = f"upload: {up['drives']} drives of {found['km']:.3f} km; the first reports {rate:.0f} changes a km"
    table = sheet(title, "what", "one, kB", "kB/km", "all, kB", "paper, kB/km", "of its fleet")
    for name, label in UPLOADS:
        one, fleet = up["single"][name]["bytes"], up["fleet"][name]["bytes"]
        table.add(label, _kb(one), _kb(one, found["km"]), _kb(fleet), _paper("single", name), _paper("fleet", name))
    return table


def _paper(stage: str, name: str) -> str:
    """What the paper's vehicles uploaded, a drive and km."""
    size = PAPER_BYTES.get(f"upload.{stage}.{name}")
    drives = PAPER_DRIVES if stage == "fleet" else 1
    return "" if size is None else f"{size / 1e3 / PAPER_KM / drives:.1f}"


def _kb(size: float | None, km: float = 1.0) -> str:
    return "" if size is None else f"{size / 1e3 / km:.2f}"


def _rates(found: Mapping[str, Any]) -> Sheet:
    up = found["upload"]
    values = {
        "kB/km up: keys and payloads": (up["kB_per_km"], 3),
        "kB/km with the transport": (up["wire_kB_per_km"], 3),
        "changes a km": (up["changed_per_km"], 0),
        "Gaussians asked for a km": (up["wanted_per_km"], 0),
        **{
            f"B/km: {part}": ({stage: of[part] for stage, of in up["parts_bytes_per_km"].items()}, 0)
            for part in up["parts_bytes_per_km"]["first"]
        },
    }
    table = sheet("upload a km, by stage", "", *(label for _, label in STAGES))
    for label, (by_stage, digits) in values.items():
        table.add(label, *(f"{by_stage[stage]:.{digits}f}" for stage, _ in STAGES))
    return table


def _codecs(found: Mapping[str, Any]) -> Sheet:
    columns = {
        "B a voxel": "{bytes_per_voxel:.3f}",
        "zstd, B": "{zstd_bytes_per_voxel:.3f}",
        "KL, nats": "{kl_median:.4f}",
        "pose shift, cm": "{pose_shift_cm_median:.3f}",
        "encode, ms": "{encode_ms:.2f}",
        "decode, ms": "{decode_ms:.2f}",
    }
    codecs = {"archive": found["codec"]["archive"], "standard": found["codec"], "compact": found["codec"]["compact"]}
    return sheet_of("codecs on this street", columns, codecs, "lattice")


def _targets(found: Mapping[str, Any]) -> Sheet:
    f1, density = found["f1"], found["upload"]["changed_per_km"]["first"]
    table = targets_sheet(
        found["targets"], f"targets, at {found['download']['voxels_per_km']} voxels and {density:.0f} changes a km"
    )
    if f1["float"] is not None:
        table.notes.append(f"F1 after {f1['drives']} drives {f1['codec']:.2f}, in floats {f1['float']:.2f}")
    return table
