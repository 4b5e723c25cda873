"""Our results beside the paper's and what we set out to reach: the one table of all."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Target:
    """One row: a value that shall be at most `must` (at least, where `larger`)."""

    name: str
    path: str
    unit: str
    paper: str
    must: float
    aim: float
    larger: bool = False

    def is_met(self, value: float, limit: float) -> bool:
        """Return whether a value is good enough."""
        return value >= limit if self.larger else value <= limit


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
    """Return each row that this study can judge: our value, the paper's, must and aim, and which of them are met."""
    values = {**found, "ratio": _ratios(found)}
    rows = {}
    for target in TARGETS:
        value = _at(values, target.path)
        if value is None:
            continue
        rows[target.name] = {
            "value": round(value, 4),
            "unit": target.unit,
            "paper": target.paper,
            "must": target.must,
            "aim": target.aim,
            "larger_is_better": target.larger,
            "met": target.is_met(value, target.must),
            "aim_met": target.is_met(value, target.aim),
        }
    return rows


def _ratios(found: Mapping[str, Any]) -> dict[str, float | None]:
    """How many times larger the point clouds are, and what F1 the codec costs."""
    ours, f1 = found["download"]["gnd"]["bytes"], found["f1"]
    ratios: dict[str, float | None] = {
        name: found["download"][name]["bytes"] / ours if found["download"][name]["bytes"] else None
        for name in ("pcd", "laz")
    }
    return ratios | {"f1_loss": None if f1["float"] is None else f1["float"] - f1["codec"]}


def _at(values: Mapping[str, Any], path: str) -> float | None:
    found: Any = values
    for name in path.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    return None if found is None else float(found)
