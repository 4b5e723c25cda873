"""Which tiles of feature layers are held back because poses were wrong, or may have been, while they were looked at.

Looks from a pose that is not good are no evidence. But a localiser that loses its place, a refined pose that
contradicts the online one, or a stretch that a shift lays better onto the map, is evidence about the poses just before
and after, too. So a tile of which much of the time was spent in such poses is not reported at all.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Final

from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.doubts import BAD_SHARE

WRONG: Final = "wrong"
POOR: Final = "poor"
GOOD: Final = "good"
Place = tuple[str, TileId]
"""Layer and tile."""


class PoseDoubts:
    """Counts, for each tile of which there is evidence, the scans by what is known of their poses."""

    def __init__(self) -> None:
        self._scans: dict[Place, Counter[str]] = {}

    def count(self, places: Iterable[Place], what: str, scans: int = 1) -> None:
        """So many scans while there is evidence of these tiles."""
        for place in places:
            self._scans.setdefault(place, Counter())[what] += scans

    def holds_back(self, place: Place) -> bool:
        """Whether a tile that is decided must not be reported; its account is closed."""
        scans = self._scans.pop(place, Counter())
        bad = scans[POOR] + scans[WRONG]
        return scans[WRONG] > 0 or (bad > 0 and bad >= BAD_SHARE * (bad + scans[GOOD]))
