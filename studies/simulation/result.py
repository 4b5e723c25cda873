"""What one vehicle's drive came to, and its file in the cache."""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import SchemaError
from studies.simulation.errors import FolderError

EVIDENCE: Final = ("n_bi", "n_bo", "n_pi", "n_po", "n_be", "n_pe", "cells", "map_cells", "change_class")
"""Columns of `VehicleResult.evidence`: the counters of the detector, occupied sub-cells of the new and of the map's
Gaussian (0: none), the class that the vehicle decided."""


@dataclass(frozen=True, slots=True, eq=False)
class VehicleResult:
    """One drive.

    Attributes:
        vehicle, sensor: name, and the sensor's short name.
        reports: encoded `ChangeReport`s, exactly what is uploaded.
        row: int32 (K,) rows of the truth about which there is evidence, ascending.
        evidence: int32 columns (K,), see `EVIDENCE`.
        stats: counts, localisation errors; plain values.
        watched: times int64 (S,) and counters int32 (S, W, 4) of the watched voxels; empty for most vehicles.
        pcd: the baseline's encoded report; empty without it.
        packed: the first half of each report in short, as the vehicle's outbox holds it; empty where it has none.
    """

    vehicle: str
    sensor: str
    reports: tuple[bytes, ...]
    row: NDArray[np.int32]
    evidence: Mapping[str, NDArray[np.int32]]
    stats: Mapping[str, Any]
    watched: tuple[NDArray[np.int64], NDArray[np.int32]] = field(
        default_factory=lambda: (np.zeros(0, np.int64), np.zeros((0, 0, 4), np.int32))
    )
    pcd: bytes = b""
    packed: tuple[bytes, ...] = ()

    @property
    def upload_bytes(self) -> int:
        """Bytes of all reports."""
        return sum(len(report) for report in self.reports)


def write_result(result: VehicleResult, key: str, path: Path) -> None:
    """Write a result; the file appears complete or not at all."""
    head: dict[str, Any] = {"key": key, "vehicle": result.vehicle, "sensor": result.sensor, "stats": dict(result.stats)}
    head["lengths"] = [len(report) for report in result.reports]
    head["packed"] = [len(half) for half in result.packed]
    arrays: dict[str, Any] = {}
    arrays["packed"] = np.frombuffer(b"".join(result.packed), np.uint8)
    arrays["reports"] = np.frombuffer(b"".join(result.reports), np.uint8)
    arrays |= {"head": np.array(json.dumps(head)), "row": result.row}
    arrays["pcd"] = np.frombuffer(result.pcd, np.uint8)
    arrays["watched_t_ns"], arrays["watched_counters"] = result.watched
    arrays["evidence"] = np.stack([result.evidence[name] for name in EVIDENCE]).astype(np.int32)
    partial = path.with_name(f".{path.name}.part")
    with partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    partial.replace(path)


def read_result(path: Path, key: str) -> VehicleResult:
    """Read a result.

    Raises:
        FolderError: it is missing, damaged or belongs to another key.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            data = dict(file)  # every array is read and its checksum compared here
        head = json.loads(str(data["head"]))
        if head["key"] != key:
            raise FolderError(f"{path} belongs to another run")
        return _result(head, data)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, SchemaError) as error:
        raise FolderError(f"cannot read {path}: {error}") from error


def _result(head: dict[str, Any], data: dict[str, NDArray[Any]]) -> VehicleResult:
    reports = _cut(data["reports"], head["lengths"])
    for report in reports:
        ChangeReport.decode(report)
    return VehicleResult(
        vehicle=head["vehicle"],
        sensor=head["sensor"],
        reports=reports,
        row=data["row"],
        evidence=dict(zip(EVIDENCE, data["evidence"], strict=True)),
        stats=head["stats"],
        watched=(data["watched_t_ns"], data["watched_counters"]),
        pcd=data["pcd"].tobytes(),
        packed=_cut(data["packed"], head["packed"]),
    )


def _cut(column: NDArray[np.uint8], lengths: list[int]) -> tuple[bytes, ...]:
    body, stops = column.tobytes(), np.cumsum([0, *lengths]).tolist()
    return tuple(body[a:b] for a, b in pairwise(stops))


def read_reports(path: Path) -> tuple[bytes, ...]:
    """The encoded reports of a result, whatever run it belongs to.

    Raises:
        FolderError: it is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return _cut(file["reports"], json.loads(str(file["head"]))["lengths"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FolderError(f"cannot read {path}: {error}") from error
