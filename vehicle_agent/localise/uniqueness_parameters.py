"""Settings of the uniqueness test: is there another place that looks the same?"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class UniquenessParameters:
    """What is compared, how often, and how clearly a pose must win.

    enabled: without, no pose has to be the only one.
    way_m, every_m, n_points: the view is of the scans of so much way, one every so many metres, of each so many points.
    n_compared: points of the view by which poses are compared; patch_m: points of one square of this side are one piece
        of evidence, and fewer than `full_points` of them a smaller one.
    high_m: above the vehicle's origin; no car is so high.
    unproven_m, proven_m: way between two tests. reach_m: around the tracked pose where GNSS tells nothing; turn_deg:
        headings within this of the tracked one, all as long as less than `course_m` have been driven.
    n_refined, n_kept: other poses tried by registration, and kept; apart_m, apart_deg: two poses nearer are one;
        beside_m: so far along and across from the tracked pose others are tried that a search might leave out.
    won, won_at_once: by how many sigmas the pose must beat each other one to be proven: three times in a row, or at
        once. lost: by how many it must be beaten, twice in a row, to be no longer so.
    """

    enabled: bool = True
    way_m: float = 25.0
    every_m: float = 0.7
    n_points: int = 300
    n_compared: int = 2000
    patch_m: float = 2.0
    full_points: int = 8
    high_m: float = 2.2
    unproven_m: float = 3.0
    proven_m: float = 20.0
    reach_m: float = 7.5
    turn_deg: float = 10.0
    course_m: float = 8.0
    n_refined: int = 16
    n_kept: int = 8
    apart_m: float = 0.4
    apart_deg: float = 1.5
    beside_m: float = 1.5
    won: float = 2.5
    won_at_once: float = 5.0
    lost: float = 3.0

    def __post_init__(self) -> None:
        numbers = [value for name in self.__slots__ if name != "enabled" and (value := getattr(self, name)) is not None]
        if not min(numbers) > 0:  # false for NaN too
            raise ValueError(f"all must be positive, got {self}")
        if self.every_m > self.way_m or self.n_kept > self.n_refined or self.won > self.won_at_once:
            raise ValueError(f"every_m <= way_m, n_kept <= n_refined and won <= won_at_once are required, got {self}")
