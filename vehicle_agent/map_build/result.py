"""The report of a build, as plain values for JSON and tables."""

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from gnd.vehicle_agent.map_build.build import BuiltMap
from gnd.vehicle_agent.map_build.double_layers import DoubleLayers
from gnd.vehicle_agent.map_build.placed_scans import NoPose
from gnd.vehicle_agent.map_build.quality import Quality


def summary(built: BuiltMap, quality: Quality) -> dict[str, Any]:
    """The figures of a build and of the map's quality."""
    missing = sum((one.without_pose for one in built.counts), Counter[NoPose]())
    return {
        "drives": len(built.sources),
        "scans": sum(one.scans for one in built.counts),
        "scans_skipped": missing.total(),
        "scans_without_pose": dict(sorted(missing.items())),
        "points": sum(one.points_used for one in built.counts),
        "points_of_movers": sum(one.movers for one in built.counts),
        "points_of_bodywork": sum(one.bodywork for one in built.counts),
        "tiles": len(built.tiles),
        "gaussians": sum(len(tile.gaussians) for tile in built.tiles),
        "versions_published": built.versions_published,
        "poses": asdict(built.poses),
        "quality": _quality(quality),
        "by_drive": _by_drive(built, quality),
        "warnings": list(quality.warnings),
    }


def _quality(quality: Quality) -> dict[str, Any]:
    low, middle, high = quality.thickness_m
    return {
        "doubled_walls": _layers(quality.walls),
        "doubled_road": _layers(quality.road),
        "plane_sd_m": {"planes": len(quality.plane_sd_m), "p10": low, "p50": middle, "p90": high},
        "way_m": sum(quality.way_m),
        "voxels_with_points": quality.voxels_seen,
    }


def _layers(layers: DoubleLayers) -> dict[str, Any]:
    return {
        "surfaces": layers.surfaces,
        "doubled": layers.doubled,
        "per_thousand": layers.per_thousand,
        "apart_m_p50": float(np.median(layers.apart_m)) if layers.doubled else None,
    }


def _by_drive(built: BuiltMap, quality: Quality) -> list[dict[str, Any]]:
    return [
        {
            "drive": source.header.drive_id,
            "file": source.path.name,
            "way_m": way_m,
            "scans": counts.scans,
            "scans_without_pose": dict(sorted(counts.without_pose.items())),
            "points": counts.points,
            "points_of_movers": counts.movers,
            "points_of_bodywork": counts.bodywork,
            "mount": asdict(mount),
        }
        for source, counts, way_m, mount in zip(built.sources, built.counts, quality.way_m, quality.mounts, strict=True)
    ]
