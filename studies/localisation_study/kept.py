"""Results of runs and trials in files: each is used again only under the key that it was made with."""

import json
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from studies.localisation_study.localising import Localised
from studies.localisation_study.series import PoseSeries
from studies.localisation_study.trials import Trial
from studies.simulation.errors import FolderError

_SERIES = ("final", "online")
_COLUMNS = ("t_ns", "error", "health")


@dataclass(frozen=True, slots=True)
class Kept:
    """Where a result lies; the key is part of the name.

    Attributes:
        home: folder.
        name: what it is.
        key: hash of all that decides it.
    """

    home: Path
    name: str
    key: str

    @property
    def path(self) -> Path:
        """The file."""
        return self.home / f"{self.name}-{self.key}.npz"

    @property
    def done(self) -> bool:
        """Whether it is there (files appear complete or not at all)."""
        return self.path.is_file()


def write_localised(found: Localised, seconds: float, kept: Kept) -> None:
    """Write a run; the file appears complete or not at all."""
    series = {name: getattr(found, name) for name in _SERIES}
    arrays = {f"{name}_{column}": getattr(one, column) for name, one in series.items() for column in _COLUMNS}
    write_arrays(kept, {"scans": found.scans, "cpu_s": seconds}, arrays)


def read_localised(kept: Kept) -> tuple[Localised, float]:
    """Read a run and the seconds of CPU that it took.

    Raises:
        FolderError: it is missing or damaged.
    """
    head, data = read_arrays(kept)
    try:
        final, online = (PoseSeries(*(data[f"{name}_{column}"] for column in _COLUMNS)) for name in _SERIES)
        return Localised(final, online, int(head["scans"])), float(head["cpu_s"])
    except KeyError as error:
        raise FolderError(f"{kept.path} is damaged: it lacks {error}; delete it and start again") from error


def write_trials(trials: list[Trial], seconds: float, kept: Kept) -> None:
    """Write trials; the file appears complete or not at all."""
    write_arrays(kept, {"trials": [asdict(trial) for trial in trials], "cpu_s": seconds}, {})


def read_trials(kept: Kept) -> list[Trial]:
    """Read trials.

    Raises:
        FolderError: they are missing or damaged.
    """
    head, _ = read_arrays(kept)
    try:
        return [Trial(**trial) for trial in head["trials"]]
    except (KeyError, TypeError) as error:
        raise FolderError(f"{kept.path} is damaged: {error}; delete it and start again") from error


def write_arrays(kept: Kept, head: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write plain values and arrays; the file appears complete or not at all."""
    kept.home.mkdir(parents=True, exist_ok=True)
    partial = kept.path.with_name(f".{kept.path.name}.part")
    with partial.open("wb") as file:
        np.savez_compressed(file, head=np.array(json.dumps(head)), **arrays)
    partial.replace(kept.path)


def read_arrays(kept: Kept) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read plain values and arrays.

    Raises:
        FolderError: they are missing or damaged.
    """
    try:
        with kept.path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            data = dict(arrays)
        return json.loads(str(data["head"])), data
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FolderError(f"cannot read {kept.path}: {error}; delete it and start again") from error
