"""Where the files of a study lie, and how it is known again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from studies.frame.errors import FolderError

_MARK: Final = "run.json"


@dataclass(frozen=True, slots=True)
class StudyFolder:
    """Paths within `--out`.

    Attributes:
        root: the folder itself.
        command: the part of `gnd reproduce` that owns it.
    """

    root: Path
    command: str = "simulation"

    @property
    def _format(self) -> str:
        return f"gnd.reproduce.{self.command}"

    @classmethod
    def create(cls, root: Path, command: str = "simulation", *, marked: bool = True) -> "StudyFolder":
        """Make the folder, or continue in one that this command made; one that is not marked may hold anything.

        Raises:
            FolderError: it holds something else, or cannot be written.
        """
        try:
            root.mkdir(parents=True, exist_ok=True)
            strange = marked and any(root.iterdir()) and not (root / _MARK).is_file()
        except OSError as error:
            raise FolderError(f"cannot write to {root}: {error.strerror}; choose another folder with --out") from error
        if strange:
            raise FolderError(f"{root} is not empty and holds no run of this command; choose another folder with --out")
        folder = cls(root, command)
        if marked and (root / _MARK).is_file():
            folder.mark()
        return folder

    @classmethod
    def begun(cls, root: Path) -> "StudyFolder":
        """Make the folder, or continue in one, and mark it as one of this command at once.

        Raises:
            FolderError: as `create`.
        """
        folder = cls.create(root)
        if not (root / _MARK).is_file():
            folder.write_mark({})
        return folder

    def mark(self) -> dict[str, Any]:
        """Return what the folder says about its last run.

        Raises:
            FolderError: it holds no such run.
        """
        try:
            found = json.loads((self.root / _MARK).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FolderError(f"{self.root} holds no run of `gnd reproduce {self.command}`: {error}") from error
        if not isinstance(found, dict) or found.get("format") != self._format:
            raise FolderError(f"{self.root} holds no run of `gnd reproduce {self.command}`: {_MARK} is of another kind")
        return found

    def finished(self) -> dict[str, Any]:
        """Return what the folder says about its last run, which has ended.

        Raises:
            FolderError: it holds no such run, or one that has not ended.
        """
        found = self.mark()
        if "compared" in found:
            several = ", ".join(sorted(path.name for path in self.root.iterdir() if (path / _MARK).is_file()))
            raise FolderError(f"{self.root} compares several runs: choose one of its folders {several}")
        if not found.get("worlds"):
            raise FolderError(f"the run in {self.root} has not ended: start it again, it continues where it was")
        return found

    def write_mark(self, content: dict[str, Any]) -> None:
        """Say what runs here."""
        self.write_json(_MARK, {"format": self._format, **content})

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a file of plain values; it appears complete or not at all."""
        partial = self.root / f".{name}.part"
        partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        partial.replace(self.root / name)

    def world(self, name: str) -> Path:
        """Return the folder of one world, made if need be."""
        path = self.root / name
        (path / "vehicles").mkdir(parents=True, exist_ok=True)
        return path
