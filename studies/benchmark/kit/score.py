"""Score a submission to the gnd-fleet benchmark. Needs Python 3.10 or newer and numpy, nothing else.

    python score.py FOLDER SUBMISSION [--json]

FOLDER is the exported benchmark with its truth, SUBMISSION a .csv or .jsonl file: one line for each voxel that the
program believes has changed. README.md, beside this file, says what the lines hold and how the figures are made.
"""

import argparse
import csv
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

FORMAT: Final = "gnd.benchmark"
VERSION: Final = 1
CLASSES: Final = ("normal", "new", "modified", "deleted", "empty")
"""A class is its position here, in the truth as well."""
CHANGES: Final = ("new", "modified", "deleted")
LEVELS: Final = ("observable", "all", "scored")
MERGED: Final = "merged"
NAME: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
"""Of a world or a vehicle: no name leads out of the folder."""
MOST: Final = 1e9
"""No world has a voxel or a metre so far away."""

_A_M, _F, _LON_TILES = 6378137.0, 1.0 / 298.257223563, 1 << 20  # WGS-84; tiles along the equator


class SubmissionError(Exception):
    """A benchmark folder or a submission that cannot be read; the message says where and why."""


# --- the voxels of a world ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VoxelFrame:
    """Where the voxels of a world lie.

    The map frame is east, north, up in metres at a point of WGS-84. A tile is 360/2^20 degrees wide and high and is cut
    into nx times ny voxels, floors are 1 m high. Voxel (0, 0, 0) of a world is the voxel `first` of the Earth.
    """

    lat_rad: float
    lon_rad: float
    height_m: float
    nx: int
    ny: int
    first: tuple[int, int, int]
    size: tuple[int, int, int]

    @classmethod
    def read(cls, path: Path) -> "VoxelFrame":
        """Read frame.json of a world."""
        found = json.loads(path.read_text(encoding="utf-8"))
        lat_rad, lon_rad, height_m, nx, ny = (found[name] for name in ("lat_rad", "lon_rad", "height_m", "nx", "ny"))
        first, size = ((int(i), int(j), int(k)) for i, j, k in (found["first"], found["size"]))
        return cls(lat_rad, lon_rad, height_m, nx, ny, first, size)

    def coordinates_of(self, points_m: F64) -> F64:
        """Voxel coordinates (N, 3) of points (N, 3) of the map frame, metres; their floors are the voxel's i, j, k."""
        lat, lon, height_m = self._geodetic(np.asarray(points_m, np.float64))
        u = (lon / (2.0 * np.pi) + 0.5) * _LON_TILES
        v = (lat / (2.0 * np.pi) + 0.25) * _LON_TILES
        return np.asarray(np.stack([u * self.nx, v * self.ny, height_m], axis=-1) - np.array(self.first))

    def voxels_of(self, points_m: F64) -> I64:
        """Voxels i, j, k, int64 (N, 3), of points (N, 3) of the map frame."""
        return np.floor(self.coordinates_of(points_m)).astype(np.int64)

    def inside(self, voxels: I64) -> NDArray[np.bool_]:
        """Which voxels (N, 3) belong to the world, bool (N,)."""
        return np.asarray(((voxels >= 0) & (voxels < np.array(self.size))).all(axis=1))

    def keys_of(self, voxels: I64) -> I64:
        """One number for each voxel (N, 3) inside the world, int64 (N,)."""
        return np.asarray((voxels[:, 0] * self.size[1] + voxels[:, 1]) * self.size[2] + voxels[:, 2])

    def _geodetic(self, p: F64) -> tuple[F64, F64, F64]:
        """Latitude, longitude and height of points of the map frame: to the Earth's centre and back (Bowring)."""
        e2, b = _F * (2.0 - _F), _A_M * (1.0 - _F)
        (s, c), (sl, cl) = ((math.sin(x), math.cos(x)) for x in (self.lat_rad, self.lon_rad))
        n = _A_M / math.sqrt(1.0 - e2 * s * s)
        R = np.array([[-sl, -s * cl, c * cl], [cl, -s * sl, c * sl], [0.0, c, s]])
        r = (n + self.height_m) * c
        x, y, z = np.moveaxis(p @ R.T + np.array([r * cl, r * sl, (n * (1.0 - e2) + self.height_m) * s]), -1, 0)
        r = np.hypot(x, y)
        beta = lat = np.arctan2(z, (1.0 - _F) * r)
        for _ in range(4):
            lat = np.arctan2(z + e2 / (1.0 - e2) * b * np.sin(beta) ** 3, r - e2 * _A_M * np.cos(beta) ** 3)
            beta = np.arctan2((1.0 - _F) * np.sin(lat), np.cos(lat))
        height = r * np.cos(lat) + z * np.sin(lat) - _A_M * np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
        return lat, np.arctan2(y, x), height


@dataclass(frozen=True)
class ScoredWorld:
    """The truth of one world: V voxels with class and levels, and which voxels the map before holds."""

    frame: VoxelFrame
    vehicles: tuple[str, ...]
    keys: I64
    true_class: U8
    masks: Mapping[str, NDArray[np.bool_]]
    in_map: I64

    @classmethod
    def read(cls, folder: Path, name: str, vehicles: Sequence[str]) -> "ScoredWorld":
        """Read a world and its truth from the exported folder."""
        world, truth = folder / "worlds" / name, folder / "truth" / name / "voxels.npz"
        try:
            frame = VoxelFrame.read(world / "frame.json")
            gaussians = np.loadtxt(world / "map_before" / "gaussians.csv", delimiter=",", skiprows=1, ndmin=2)
            with truth.open("rb") as stream, np.load(stream, allow_pickle=False) as columns:
                data = dict(columns)
            return cls._of(frame, vehicles, gaussians, data)
        except Exception as error:  # a damaged table or archive leads to any of numpy's, zipfile's, zlib's and json's
            reason = f"{type(error).__name__}: {error}"
            raise SubmissionError(f"world {name} of {folder} cannot be read: {reason[:300]}") from error

    @classmethod
    def _of(
        cls, frame: VoxelFrame, vehicles: Sequence[str], gaussians: F64, data: Mapping[str, NDArray[Any]]
    ) -> "ScoredWorld":
        keys = frame.keys_of(data["ijk"].astype(np.int64))
        order = np.argsort(keys)
        observable, clear = data["observable"][order], data["clear"][order]
        masks = {"observable": observable, "all": np.ones(len(keys), np.bool_), "scored": observable & clear}
        in_map = np.sort(frame.keys_of(gaussians[:, :3].astype(np.int64)))
        return cls(frame, tuple(vehicles), keys[order], data["class"][order].astype(np.uint8), masks, in_map)

    def predicted(self, keys: I64, classes: U8) -> tuple[U8, int]:
        """The class of each voxel of the truth, uint8 (V,), and how many reported voxels the truth does not know.

        What is not reported is as in the map before: "normal" where it holds a Gaussian, else "empty".
        """
        held = np.isin(self.keys, self.in_map)
        found = np.where(held, CLASSES.index("normal"), CLASSES.index("empty")).astype(np.uint8)
        at = np.searchsorted(self.keys, keys)
        known = at < len(self.keys)
        known[known] = self.keys[at[known]] == keys[known]
        found[at[known]] = classes[known]
        return found, int((~known).sum())


# --- submissions ----------------------------------------------------------------------------------------------------

Reported = dict[tuple[str, str], tuple[I64, U8]]
"""By world and vehicle (or "merged"): keys of voxels and their classes."""


@dataclass(frozen=True)
class _Row:
    """One line: where it stands, whether it names a voxel or a point."""

    line: int
    world: str
    who: str
    place: tuple[float, float, float]
    is_point: bool
    change: int


def read_submission(path: Path, worlds: Mapping[str, ScoredWorld]) -> Reported:
    """Read a submission and refuse what cannot be meant.

    Raises:
        SubmissionError: with the line: an unknown world, vehicle or class, no number, a voxel outside of the world,
            twice, or with a class that the map before contradicts.
    """
    groups: dict[tuple[str, str], list[_Row]] = {}
    for row in _rows(path):
        if row.world not in worlds:
            raise SubmissionError(f"{path}:{row.line}: unknown world {row.world!r}; there are {', '.join(worlds)}")
        known = (MERGED, *worlds[row.world].vehicles)
        if row.who not in known:
            raise SubmissionError(f"{path}:{row.line}: unknown vehicle {row.who!r}; there are {', '.join(known)}")
        groups.setdefault((row.world, row.who), []).append(row)
    return {group: _voxels(path, worlds[group[0]], rows) for group, rows in groups.items()}


def _rows(path: Path) -> Iterator[_Row]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            if path.suffix == ".csv":
                yield from (_row(path, line, one) for line, one in enumerate(csv.DictReader(file), 2))
            elif path.suffix == ".jsonl":
                yield from (_row(path, line, json.loads(text)) for line, text in enumerate(file, 1) if text.strip())
            else:
                raise SubmissionError(f"{path}: a submission is a .csv or a .jsonl file")
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        raise SubmissionError(f"{path} cannot be read: {error}") from error


def _row(path: Path, line: int, found: Any) -> _Row:
    where = f"{path}:{line}"
    if not isinstance(found, dict):
        raise SubmissionError(f"{where}: an object is needed, got {str(found)[:60]!r}")
    names = ("i", "j", "k") if "i" in found else ("x", "y", "z")
    missing = [name for name in ("world", "class", *names) if found.get(name) in (None, "")]
    if missing:
        raise SubmissionError(f"{where}: no {', '.join(missing)}; world, class, and i,j,k or x,y,z are needed")
    if found["class"] not in CHANGES:
        raise SubmissionError(f"{where}: class {found['class']!r}; it is one of {', '.join(CHANGES)}")
    try:
        x, y, z = (float(found[name]) for name in names)
    except (TypeError, ValueError, OverflowError) as error:
        raise SubmissionError(f"{where}: {error}") from error
    if not all(abs(number) <= MOST for number in (x, y, z)):  # NaN fails, too
        raise SubmissionError(f"{where}: {', '.join(names)} = {x}, {y}, {z}: finite numbers are needed, up to {MOST:g}")
    if names[0] == "i" and not all(number.is_integer() for number in (x, y, z)):
        raise SubmissionError(f"{where}: i, j, k = {x}, {y}, {z}: integers are needed")
    who = found.get("vehicle") or MERGED
    return _Row(line, str(found["world"]), str(who), (x, y, z), names[0] == "x", CLASSES.index(found["class"]))


def _voxels(path: Path, world: ScoredWorld, rows: Sequence[_Row]) -> tuple[I64, U8]:
    """Keys and classes of the rows of one world and vehicle, checked."""
    place = np.array([row.place for row in rows])
    points = np.array([row.is_point for row in rows])
    voxels = np.where(points[:, None], np.floor(world.frame.coordinates_of(place)), place).astype(np.int64)
    outside = np.flatnonzero(~world.frame.inside(voxels))
    if len(outside):
        row, size = rows[outside[0]], world.frame.size
        raise SubmissionError(
            f"{path}:{row.line}: {row.place} is voxel {voxels[outside[0]].tolist()}, outside of the world {row.world}, "
            f"which has {size[0]} x {size[1]} x {size[2]} voxels"
        )
    keys, change = world.frame.keys_of(voxels), np.array([row.change for row in rows], np.uint8)
    _refuse_twice(path, rows, keys, change, points)
    _refuse_contradiction(path, rows, np.isin(keys, world.in_map), change)
    kept, first = np.unique(keys, return_index=True)
    return kept, change[first]


def _refuse_twice(path: Path, rows: Sequence[_Row], keys: I64, change: U8, points: NDArray[np.bool_]) -> None:
    """Voxels may come once; several points of one voxel may come, all of one class."""
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    both_points = points[order][1:] & points[order][:-1]
    bad = np.flatnonzero(same & ~(both_points & (change[order][1:] == change[order][:-1])))
    if len(bad):
        one, two = rows[order[bad[0]]], rows[order[bad[0] + 1]]
        raise SubmissionError(
            f"{path}:{two.line}: the voxel of {two.place} in world {two.world} was reported on line {one.line} already;"
            f" {len(bad)} such lines"
        )


def _refuse_contradiction(path: Path, rows: Sequence[_Row], held: NDArray[np.bool_], change: U8) -> None:
    """What is new is not in the map before; what is modified or deleted is."""
    bad = np.flatnonzero(held == (change == CLASSES.index("new")))
    if len(bad):
        row, there = rows[bad[0]], bool(held[bad[0]])
        raise SubmissionError(
            f"{path}:{row.line}: {row.place} in world {row.world} is called {CLASSES[row.change]!r}, but the map before"
            f" holds {'a' if there else 'no'} Gaussian there; {len(bad)} such lines"
        )


# --- figures --------------------------------------------------------------------------------------------------------


def figures_of(confusion: I64) -> dict[str, Any]:
    """F1 and its parts, percent, of a confusion matrix (5, 5), rows true, columns predicted, in the order of `CLASSES`.

    `f1` is the mean over the five classes, `changes_f1` over the three classes of change. `false_per_1000` counts
    unchanged voxels that are called changed, of 1,000 voxels that hold a Gaussian before or after.
    """
    hits = np.diag(confusion).astype(float)
    precision = 100.0 * hits / np.maximum(confusion.sum(axis=0), 1)
    recall = 100.0 * hits / np.maximum(confusion.sum(axis=1), 1)
    f1 = 2.0 * precision * recall / np.maximum(precision + recall, 1e-12)
    rows = zip(CLASSES, precision.tolist(), recall.tolist(), f1.tolist(), strict=True)
    classes = {name: {"precision": p, "recall": r, "f1": f} for name, p, r, f in rows}
    unchanged = confusion[CLASSES.index("normal")] + confusion[CLASSES.index("empty")]
    holding = max(int(confusion.sum() - confusion[CLASSES.index("empty")].sum()), 1)
    return {
        "f1": float(np.mean(f1)),
        "changes_f1": float(np.mean([classes[name]["f1"] for name in CHANGES])),
        "classes": classes,
        "false_per_1000": {name: 1000.0 * int(unchanged[CLASSES.index(name)]) / holding for name in CHANGES},
        "confusion": confusion.tolist(),
    }


def score_map(world: ScoredWorld, keys: I64, classes: U8) -> dict[str, Any]:
    """The figures of one map of one world, by level, and how many reported voxels the truth does not know."""
    predicted, unknown = world.predicted(keys, classes)
    n = len(CLASSES)
    found: dict[str, Any] = {}
    for level, mask in world.masks.items():
        pairs = world.true_class[mask].astype(np.int64) * n + predicted[mask]
        found[level] = figures_of(np.bincount(pairs, minlength=n * n).reshape(n, n))
    return {**found, "unknown_voxels": unknown}


def score(worlds: Mapping[str, ScoredWorld], reported: Reported) -> dict[str, Any]:
    """All figures of a submission: of merged maps and of single vehicles, each with mean, worst and every part.

    Of a kind of which anything is reported, every map counts: what a submission leaves out has reported nothing.
    """
    nothing = np.zeros(0, np.int64), np.zeros(0, np.uint8)
    kinds = {"merged": [(name, MERGED) for name in worlds],
             "single": [(name, who) for name, world in worlds.items() for who in world.vehicles]}  # fmt: skip
    found: dict[str, Any] = {"missing": []}
    for kind, maps in kinds.items():
        if any(one in reported for one in maps):
            parts = {"/".join(one): score_map(worlds[one[0]], *reported.get(one, nothing)) for one in maps}
            found[kind] = {"mean": _over(parts, np.mean), "worst": _worst(parts), "maps": parts}
            found["missing"] += ["/".join(one) for one in maps if one not in reported]
    stale = {name: score_map(world, *nothing) for name, world in worlds.items()}
    return {**found, "stale": {"mean": _over(stale, np.mean), "worst": _worst(stale), "maps": stale}}


def _over(parts: Mapping[str, Any], of: Any) -> dict[str, Any]:
    """A number for each figure of each level over all maps."""
    return {
        level: {
            "f1": float(of([one[level]["f1"] for one in parts.values()])),
            "changes_f1": float(of([one[level]["changes_f1"] for one in parts.values()])),
            **{name: float(of([one[level]["classes"][name]["f1"] for one in parts.values()])) for name in CHANGES},
            "false_per_1000": float(of([sum(one[level]["false_per_1000"].values()) for one in parts.values()])),
        }
        for level in LEVELS
    }


def _worst(parts: Mapping[str, Any]) -> dict[str, Any]:
    low, high = _over(parts, min), _over(parts, max)
    return {level: low[level] | {"false_per_1000": high[level]["false_per_1000"]} for level in LEVELS}


def plain_name(name: Any) -> str:
    """The name of a world or a vehicle, which is that of its folder, too.

    Raises:
        SubmissionError: it could lead out of the folder of the benchmark.
    """
    if not isinstance(name, str) or not re.fullmatch(NAME, name):
        raise SubmissionError(
            f"{str(name)[:80]!r} is no name of a world or a vehicle: letters, digits, _ - and . inside"
        )
    return name


def read_worlds(folder: Path) -> dict[str, ScoredWorld]:
    """Read all worlds of an exported benchmark, with their truth.

    Raises:
        SubmissionError: it is no benchmark of this version, is not finished, or lacks its truth.
    """
    try:
        found = json.loads((folder / "benchmark.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SubmissionError(f"{folder} is no exported benchmark: {error}") from error
    if not isinstance(found, dict):
        raise SubmissionError(f"{folder}/benchmark.json holds no object")
    if (found.get("format"), found.get("version")) != (FORMAT, VERSION):
        raise SubmissionError(f"{folder}/benchmark.json is not of format {FORMAT}, version {VERSION}")
    if not found.get("finished"):
        raise SubmissionError(f"the export into {folder} has not ended: start it again, it goes on where it was")
    try:
        worlds = [(plain_name(one["name"]), tuple(map(plain_name, one["vehicles"]))) for one in found["worlds"]]
    except (KeyError, TypeError) as error:
        raise SubmissionError(f"{folder}/benchmark.json: worlds with names and vehicles are needed: {error}") from error
    return {name: ScoredWorld.read(folder, name, vehicles) for name, vehicles in worlds}


# --- the command ----------------------------------------------------------------------------------------------------


def main(arguments: Iterable[str] | None = None) -> int:
    """Run the command line; the exit code is 2 where something cannot be read."""
    parser = argparse.ArgumentParser(description="Score a submission to the gnd-fleet benchmark.")
    parser.add_argument("folder", type=Path, help="the exported benchmark, with truth/")
    parser.add_argument("submission", type=Path, help="a .csv or .jsonl file")
    parser.add_argument("--json", action="store_true", help="print everything as JSON instead of a table")
    given = parser.parse_args(None if arguments is None else list(arguments))
    try:
        worlds = read_worlds(given.folder)
        found = score(worlds, read_submission(given.submission, worlds))
    except SubmissionError as error:
        print(f"score.py: {error}", file=sys.stderr)
        return 2
    print(json.dumps(found, indent=2) if given.json else table_of(found))
    return 0


def table_of(found: Mapping[str, Any]) -> str:
    """The figures as text: a line for each kind of map and each level."""
    head = ("map", "level", "F1", "worst", "changes", "new", "modified", "deleted", "false of 1,000", "worst")
    lines: list[tuple[str, ...]] = [head]
    for kind in ("stale", "single", "merged"):
        if kind in found:
            mean, worst = found[kind]["mean"], found[kind]["worst"]
            lines += [(kind, level, *_cells(mean[level], worst[level])) for level in LEVELS]
    wide = [max(len(line[column]) for line in lines) for column in range(len(head))]
    text = ["  ".join(line[c].ljust(w) if c < 2 else line[c].rjust(w) for c, w in enumerate(wide)) for line in lines]
    if found["missing"]:
        text.append(f"not in the submission, so scored as without any change: {', '.join(found['missing'])}")
    return "\n".join(text)


def _cells(mean: Mapping[str, float], worst: Mapping[str, float]) -> tuple[str, ...]:
    names = ("changes_f1", *CHANGES)
    of_mean = tuple(f"{mean[name]:.2f}" for name in names)
    false = f"{mean['false_per_1000']:.2f}", f"{worst['false_per_1000']:.2f}"
    return (f"{mean['f1']:.2f}", f"{worst['f1']:.2f}", *of_mean, *false)


if __name__ == "__main__":
    sys.exit(main())
