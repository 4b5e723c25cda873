"""Where the drives and the map of a run come from."""

from dataclasses import dataclass
from pathlib import Path

from gnd.deploy.errors import DeployError
from gnd.tile_store.location import file_of


@dataclass(frozen=True, slots=True)
class Source:
    """Recorded drives, or a simulated world.

    Attributes:
        drives: MCAP files or folders; empty for a simulated world.
        base_map: a store with the map of the recorded drives, None to start without a map.
        worlds: folder that keeps simulated worlds for further runs, None to keep them in the run.
        agents: number of vehicles as asked for, None where it was not.
        made_up: boxes to put into the scans of recorded drives.
    """

    drives: tuple[Path, ...] = ()
    base_map: Path | None = None
    worlds: Path | None = None
    agents: int | None = None
    made_up: int = 0

    def __post_init__(self) -> None:
        """Refuse options that contradict each other."""
        if self.base_map is not None and not self.drives:
            raise DeployError("--map goes with --drives: a simulated run builds its own map")
        if self.base_map is not None and file_of(str(self.base_map)) is None:
            raise DeployError(
                "--map takes a file: a run has its own store; one in a database is for `gnd store` and `gnd merger`"
            )
        if self.made_up and not self.drives:
            raise DeployError("--made-up goes with --drives: a simulated street has changes of its own")
        if self.worlds is not None and self.drives:
            raise DeployError("--worlds is for simulated runs, --drives for recorded ones: give one of them")
