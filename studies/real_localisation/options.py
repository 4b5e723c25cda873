"""What a run of `gnd reproduce real-localisation` is made of."""

from dataclasses import dataclass
from pathlib import Path

from studies.real_localisation.errors import RealLocalisationError


@dataclass(frozen=True, slots=True)
class RealLocalisationOptions:
    """scans: folders or files, each of a recording with LiDAR or of one to georeference. at_most: scans that are read.

    seed: of the offsets of registration.
    """

    scans: tuple[Path, ...]
    at_most: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.scans or self.at_most < 4:
            raise RealLocalisationError(
                f"{len(self.scans)} recordings, at most {self.at_most} scans: 1 and 4 are needed"
            )
        missing = [str(path) for path in self.scans if not path.exists()]
        if missing:
            raise RealLocalisationError(f"{', '.join(missing)}: no such file or folder")
        names = [path.name for path in self.scans]
        if len(set(names)) != len(names):
            raise RealLocalisationError(f"--scans {', '.join(names)}: one name twice would share its results")

    @classmethod
    def of(cls, scans: str, at_most: int, seed: int) -> "RealLocalisationOptions":
        """From paths with commas between them."""
        return cls(tuple(Path(part.strip()) for part in scans.split(",") if part.strip()), at_most, seed)
