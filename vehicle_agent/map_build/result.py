"""What a build says about itself, as plain values for JSON and tables."""

from collections import Counter
from typing import Any

from vehicle_agent.map_build.build import BuiltMap
from vehicle_agent.map_build.placed_scans import NoPose


def summary(built: BuiltMap) -> dict[str, Any]:
    """The figures of a build."""
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
    }
