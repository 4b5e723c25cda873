"""A finished run as its folder holds it: what a report needs, and what of it is missing."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

from gnd.deploy.account import FleetResults, TileHistory, tile_histories
from gnd.deploy.errors import ReportError
from gnd.deploy.map_export.changes import ChangedVoxels, changes_of_tiles
from gnd.deploy.run_folder import MARK, RunFolder
from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger_file import read_run, run_folder
from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_bus.settings_file import SETTINGS_FILE
from gnd.fleet_bus.traffic import DEFAULT_LINKS, AgentTraffic, agent_traffic
from gnd.fleet_sim.truth import Truth, read_truth
from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.errors import GndError
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER

TRUTH_FILE: Final = "truth.npz"
_MOST_JSON_BYTES: Final = 256 << 20
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """What a report tells of a run.

    Attributes:
        folder: the run.
        name: of its folder.
        mark: of `run.json`.
        settings: text of the effective settings, "" where there is none.
        summary: of `summary.json`, empty where there is none.
        results: of the vehicles.
        tiles: each tile before and after.
        versions: number of versions of each tile, in the order of `tiles`.
        changes: what changed as objects; None: scikit-learn is not installed.
        traffic: account of each vehicle.
        links: profiles to compare with.
        truth: of the simulated world, None without.
        missing: what could not be read, each with its reason.
    """

    folder: RunFolder
    name: str
    mark: dict[str, Any]
    settings: str
    summary: dict[str, Any]
    results: tuple[dict[str, Any], ...]
    tiles: tuple[TileHistory, ...]
    versions: tuple[int, ...]
    changes: ChangedVoxels | None
    traffic: tuple[AgentTraffic, ...]
    links: tuple[LinkProfile, ...]
    truth: Truth | None
    missing: tuple[str, ...]


@dataclass(slots=True)
class _Reading:
    """Reads parts; one that fails becomes a line of what is missing."""

    missing: list[str] = field(default_factory=list)

    def part(self, what: str, read: Callable[[], _T], instead: _T) -> _T:
        try:
            return read()
        except (GndError, OSError, ValueError, LookupError, TypeError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self.missing.append(f"{what}: {reason}")
            return instead


def read_finished_run(run: Path, truth: Path | None = None) -> FinishedRun:
    """Read a run; only its mark and its store must be there.

    Args:
        run: the folder, or its name below `runs/`.
        truth: file with the truth where it does not lie in the run (`gnd fleet --worlds`).

    Raises:
        ReportError: no folder of a run, or its store cannot be read.
        TruthError: `truth` is given and cannot be read.
    """
    folder = RunFolder(_folder_of(run))
    reading = _Reading()
    mark = reading.part(MARK, lambda: _object(folder.mark), dict[str, Any]())
    summary = reading.part("summary.json (has the run ended?)", lambda: _object(folder.summary), dict[str, Any]())
    settings = reading.part(SETTINGS_FILE, lambda: (folder.root / SETTINGS_FILE).read_text(encoding="utf-8"), "")
    results = reading.part(
        "results of vehicles", lambda: FleetResults.read(folder).results, tuple[dict[str, Any], ...]()
    )
    links = tuple(load_link(link) for link in DEFAULT_LINKS)
    traffic = reading.part("traffic", lambda: _traffic(folder, links), tuple[AgentTraffic, ...]())
    tiles, versions, changes = _map_of(folder, reading)
    return FinishedRun(
        folder, folder.root.resolve().name, mark, settings, summary, tuple(one for one in results if _is_result(one)),
        tiles, versions, changes, traffic, links, _truth_of(folder, truth, summary, reading), tuple(reading.missing),
    )  # fmt: skip


def _folder_of(run: Path) -> Path:
    try:
        folder = run_folder(run)
    except LedgerError as error:
        raise ReportError(str(error)) from None
    if not (folder / MARK).is_file():
        raise ReportError(f"{folder} holds no run ({MARK} is missing): `gnd fleet --out FOLDER` makes one")
    return folder


def _object(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MOST_JSON_BYTES:
        raise ValueError(f"{path.stat().st_size} bytes, at most {_MOST_JSON_BYTES} are read")
    value = json_value(path.read_bytes())
    if not isinstance(value, dict):
        raise ValueError("it holds no object")  # noqa: TRY004 - what the file says, not what was passed
    return value


def _is_result(value: object) -> bool:
    return isinstance(value, dict) and isinstance(value.get("vehicle"), str)


def _traffic(folder: RunFolder, links: tuple[LinkProfile, ...]) -> tuple[AgentTraffic, ...]:
    return tuple(agent_traffic(ledger, links) for ledger in read_run(folder.root))


def _map_of(
    folder: RunFolder, reading: _Reading
) -> tuple[tuple[TileHistory, ...], tuple[int, ...], ChangedVoxels | None]:
    """Tiles, number of versions of each, changes.

    Raises:
        ReportError: there is no store, or it cannot be read.
    """
    if not folder.store.is_file():
        raise ReportError(f"{folder.root} holds no map ({folder.store.name} is missing): the run was ended too early")
    try:
        with open_store(folder.store, create=False) as store:
            tiles = tuple(tile_histories(store))
            versions = tuple(len(store.history(DEFAULT_LAYER, one.tile.tile)) for one in tiles)
            changes = reading.part("list of changes", lambda: _changes(store, tiles), None)
    except (GndError, LookupError) as error:
        raise ReportError(f"cannot read the map of the run, {folder.store}: {error}") from error
    return tiles, versions, changes


def _changes(store: SqlStore, tiles: tuple[TileHistory, ...]) -> ChangedVoxels | None:
    pairs = ((one.tile.tile, one.base, one.tile) for one in tiles)
    return changes_of_tiles(store, DEFAULT_LAYER, pairs, same_store=True)


def _truth_of(folder: RunFolder, given: Path | None, summary: dict[str, Any], reading: _Reading) -> Truth | None:
    if given is not None:
        return read_truth(given)
    own = folder.world / TRUTH_FILE
    if own.is_file():
        return reading.part("truth", lambda: read_truth(own), None)
    is_simulated = isinstance(summary.get("f1"), dict) and summary["f1"].get("after") is not None
    if is_simulated:
        reading.missing.append(f"truth: {own} is not there; with `gnd fleet --worlds` name it by --truth")
    return None
