"""Hashes over the programs and options that decide a result: what is kept is used only while they are the same."""

import hashlib
import importlib.resources
import json
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

SIMULATOR: Final = ("fleet_sim", "gnd_map", "schemas")
VEHICLE: Final = (
    *SIMULATOR,
    "vehicle_agent/detect",
    "vehicle_agent/localise",
    "vehicle_agent/segment",
    "vehicle_agent/report.py",
    "vehicle_agent/packing.py",
    "vehicle_agent/tracks.py",
    "vehicle_agent/local_map.py",
    "vehicle_agent/place.py",
    "vehicle_agent/scans.py",
    "vehicle_agent/surroundings.py",
    "vehicle_agent/pipeline.py",
    "vehicle_agent/tiles_at_hand.py",
    "studies/simulation/vehicle.py",
    "studies/simulation/poses.py",
    "studies/simulation/base_map.py",
    "studies/simulation/masses.py",
    "studies/simulation/labels.py",
    "studies/simulation/streams.py",
    "studies/simulation/kept_evidence.py",
    "studies/simulation/voxel_rows.py",
)
_SUFFIXES: Final = (".py", ".json", ".npz", ".toml")
_DECIDE_NOTHING: Final = ("cli.py", "pictures.py", "ellipsoids.py", "evaluate.py", "insert.py", "insert_drive.py")
"""Files of the simulator that no drive and no truth depends on."""
PCD: Final = ("studies/pcd", "studies/simulation/baseline.py")


@lru_cache
def sources_sha(parts: tuple[str, ...]) -> str:
    """Return the SHA-256, hexadecimal, over the programs and tables of packages, folders and files of this project."""
    digest = hashlib.sha256()
    for part in parts:
        for path in _files(part):
            digest.update(f"{part}/{path.name}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _files(part: str) -> Iterable[Path]:
    package, _, inside = part.partition("/")
    name = package if package == "studies" else f"gnd.{package}"
    path = Path(str(importlib.resources.files(name))) / inside
    if path.is_file():
        return [path]
    return sorted(p for p in path.rglob("*") if p.suffix in _SUFFIXES and p.name not in _DECIDE_NOTHING)


def key_of(**what: Any) -> str:
    """Return a short hash, hexadecimal, of plain values that decide a result."""
    text = json.dumps(what, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
