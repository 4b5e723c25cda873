"""Settings of staged release."""

from dataclasses import dataclass

from gnd.cloud_merger.errors import MergerError
from gnd.gnd_map.settings import check_settings, setting
from gnd.tile_store.trials import TrialTerms


@dataclass(frozen=True, slots=True)
class ReleaseParameters:
    """Which share of the fleet gets a new version of a tile first."""

    share: float = setting(
        0.0,
        "Share of the vehicles that get a new version of a tile of the voxel map first, other ones for each tile; the"
        " others get it when nobody fares worse on it (docs/release.md). 0: everybody gets it at once.",
        least=0,
        most=0.5,
    )
    longest_h: float = setting(
        24.0, "A version that hardly anybody has tried for so long is everybody's.", unit="h", above=0
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)

    @property
    def terms(self) -> TrialTerms | None:
        """Those of a trial; None: there are none."""
        return TrialTerms(self.share, self.longest_h * 3600.0) if self.share > 0 else None
