"""What most people do next: each command of the way from a recording to a healed map names the one after it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from gnd.deploy.run_folder import RunFolder
from gnd.schemas.drive_mcap import GNSS_TOPIC, MOTION_TOPIC, topics_of

BOXES: Final = 4
RUN: Final = "healed"


def after_map_build(drives: Sequence[Path], store: Path | str) -> list[str]:
    """With a recording of another day, and with this one alone."""
    alone = next((drive for drive in drives if {GNSS_TOPIC, MOTION_TOPIC} <= set(topics_of(drive))), None)
    lines = [
        f"next: gnd fleet --drives LATER --map {store} --out {RUN} (LATER: the same street, recorded on another day)"
    ]
    if alone is None:
        return [*lines, "  (vehicles need fixes and speeds: a recording without them is imported with --stand-ins)"]
    return [
        *lines,
        f"  or, without another day: gnd fleet --drives {alone} --agents 2 --map {store} --made-up {BOXES}"
        f" --out {RUN} (two vehicles meet made-up boxes)",
    ]


def after_fleet(summary: dict[str, Any], base_map: Path, folder: RunFolder) -> list[str]:
    """What has changed, as a list, in pictures, and on."""
    if not summary["drive_km"]:
        return [
            f"no vehicle found its place on {base_map}: is it a map of this street, and do the drives have fixes and"
            " speeds (imported with --stand-ins where none were measured)?",
            f"next: gnd map info {base_map}; gnd import auto DRIVE",
        ]
    if not summary["tiles_published"]:
        return [f"next: gnd map status {folder.store} (nothing was published)"]
    return [
        f"next: gnd map diff {base_map} {folder.store} --to changes.gpkg (a row for each changed object, for a GIS)",
        f"  or: gnd view {folder.root} (the map and its changes in Rerun); picture: {folder.root / 'map_after.png'}",
    ]
