"""A finished study as plain values: the JSON of `gnd reproduce traffic`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import fmean
from typing import Any, Final

from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.gnd_map.config import to_mapping
from studies.simulation.run import plain_options
from studies.traffic_study.download import Question, fetched_tiles, total_bytes
from studies.traffic_study.study import PUBLISHED, RETURN_SHARE, DownloadOutcome, StudyOutcome
from studies.traffic_study.targets import targets_of
from studies.traffic_study.uploads import PARTS, DriveUpload

FIRST_DRIVES: Final = 8
"""`flags_first` is the mean over so many drives."""


def summary_of(outcome: StudyOutcome) -> dict[str, Any]:
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


def _codec(outcome: StudyOutcome) -> dict[str, Any]:
    measures = {name: _rounded(asdict(one)) for name, one in outcome.codecs.items()}
    return {**measures[PUBLISHED], **{name: one for name, one in measures.items() if name != PUBLISHED}}


def _f1(outcome: StudyOutcome) -> dict[str, Any]:
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


def _parameters(outcome: StudyOutcome) -> dict[str, Any]:
    world = plain_options(outcome.options.world)
    return {
        **{name: value for name, value in to_mapping(outcome.options).items() if name not in ("method", "poses")},
        "poses": world["poses"],
        "method": world["method"],
    }


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in values.items()}
