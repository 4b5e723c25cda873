"""Settings of what doubts a pose: the witness, the hypotheses of the first pose, and the challenge of a tracked one."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WitnessParameters:
    """What the rays are asked about the pose.

    n_rays: asked at a time, every `period_s` or `way_m`; sectors: around the vehicle, counted with `least_points`.
    above_ground_m: standing points are higher than this above the ground.
    hit_sigmas, far_sigmas: a point nearer than the one to a Gaussian is a hit, farther than the other from all is new.
    behind_m: a Gaussian is gone when a ray went on for so long behind it; least_along_per_m2: least information of the
        Gaussian along the ray, so that grazing rays say nothing; max_way_m: a ray is followed no farther than this.
    """

    n_rays: int = 600
    period_s: float = 0.5
    way_m: float = 5.0
    sectors: int = 12
    least_points: int = 8
    above_ground_m: float = 0.4
    hit_sigmas: float = 3.0
    far_sigmas: float = 8.0
    behind_m: float = 1.0
    least_along_per_m2: float = 50.0
    max_way_m: float = 60.0

    def __post_init__(self) -> None:
        if min(self.n_rays, self.sectors, self.least_points) < 1 or not 0 < self.hit_sigmas < self.far_sigmas:
            raise ValueError(f"positive counts and 0 < hit_sigmas < far_sigmas are required, got {self}")


@dataclass(frozen=True, slots=True)
class PoolParameters:
    """Scans looked at together: one every `every_m`, those of the last `reach_m`, of each but the newest `n_points`;
    above_ground_m: standing points are higher than this above the ground.
    """

    every_m: float = 0.7
    reach_m: float = 10.0
    n_points: int = 400
    above_ground_m: float = 0.4

    def __post_init__(self) -> None:
        if not 0 < self.every_m <= self.reach_m or self.n_points < 1:
            raise ValueError(f"0 < every_m <= reach_m and n_points >= 1 are required, got {self}")


@dataclass(frozen=True, slots=True)
class HypothesisParameters:
    """How several poses are followed until one of them has won.

    n_most: how many are followed; n_points: that each is registered with; apart_m, apart_deg: two poses nearer than
        this are one.
    gain: how many times likelier a pose is (as a logarithm) for a whole unit of mean fit more, one view.
    view_m, most_views: the way after which a scan is a new view, and how many views count: what is stale stays so.
    none_fit: mean fit of the hypothesis that it is none of them. innovation_m, innovation_deg: one sigma of how far a
        right pose's registration moves it from where odometry has put it.
    twin_m, twin_deg: poses nearer than this share their probability.
    sure: least probability of a winner, after `least_scans` scans; at_once, alone: a fit so good, with a runner-up of
        less than this share of it, wins at the first.
    dropped: a hypothesis this much less probable than the best is given up.
    """

    n_most: int = 8
    n_points: int = 1000
    apart_m: float = 0.3
    apart_deg: float = 1.0
    gain: float = 50.0
    view_m: float = 2.0
    most_views: float = 3.0
    none_fit: float = 0.35
    innovation_m: float = 0.1
    innovation_deg: float = 0.4
    twin_m: float = 0.5
    twin_deg: float = 2.0
    sure: float = 0.99
    least_scans: int = 3
    at_once: float = 0.75
    alone: float = 0.75
    dropped: float = 1e-6

    def __post_init__(self) -> None:
        if min(self.n_most, self.n_points, self.least_scans) < 1 or not 0.5 < self.sure < 1:
            raise ValueError(f"positive counts and 0.5 < sure < 1 are required, got {self}")
        if min(self.gain, self.view_m, self.innovation_m, self.innovation_deg) <= 0 or self.most_views < 1:
            raise ValueError(f"gain, view_m and innovations must be positive and most_views >= 1, got {self}")


@dataclass(frozen=True, slots=True)
class ChallengeParameters:
    """How often, and where, a better pose than the tracked one is looked for.

    period_s, doubtful_s: pause between two searches, and when the pose is in doubt; turn_deg: headings within this of
        the tracked one; n_refined: how many are refined; reach_m: around the tracked pose where there is no GNSS;
    lead: a rival must fit better by this much to be one. prior: how much likelier the tracked pose is before anything
        is seen; most_views: how many views may speak against it. contested, beaten, dropped: odds of a rival from which
        on the tracked pose is degraded, is lost, and below which the rival is given up. All odds are logarithms.
    near_m, near_deg: a rival nearer than this must fit well to win.
    """

    period_s: float = 2.0
    doubtful_s: float = 0.8
    turn_deg: float = 12.0
    n_refined: int = 5
    reach_m: float = 5.0
    lead: float = 0.03
    prior: float = 6.0
    most_views: float = 8.0
    contested: float = -2.0
    beaten: float = 4.0
    dropped: float = -12.0
    near_m: float = 1.0
    near_deg: float = 3.0

    def __post_init__(self) -> None:
        if not 0 < self.doubtful_s <= self.period_s or self.n_refined < 1 or self.reach_m <= 0:
            raise ValueError(f"0 < doubtful_s <= period_s, n_refined >= 1 and reach_m > 0 are required, got {self}")
        if not self.dropped < self.contested < self.beaten or self.most_views < 1:
            raise ValueError(f"dropped < contested < beaten and most_views >= 1 are required, got {self}")


@dataclass(frozen=True, slots=True)
class CauseParameters:
    """What makes a wrong pose, a stale map and a poor place.

    testimonies: how many of the witness's last ones are averaged.
    trusted_standing_fit: least fit of what stands, beside `HealthParameters.trusted_fit` of all points.
    fitting_hits: share of hits in the better half of the sectors that is no sign of a wrong pose; suspicious_gone:
        share of Gaussians gone from which on a better pose is looked for sooner.
    wrong_hits, wrong_share: with hits below, new and gone together above these, the pose is contradicted all around.
    stale_share: share of points new and of Gaussians gone, added up, that makes a map stale.
    poor_sigma_m, poor_sigma_rad: one sigma of position and heading from which on a pose is no longer good.
    least_standing: fewer standing points among the witness's rays are next to nothing; least_known: a smaller share of
        the points in known voxels means that there is no map.
    motion_gap_s, gap_s: after so long without motion samples, or without a believed match, the pose must prove itself
        again. lost_gap_s: after so long without scans it is lost; longest_s, lost_sigma_m: where the map is stale or
        the place is poor, it is lost after so long without a believed match, or with so large a sigma.
    partly_matched: matching ratio from which on a scan that is not believed still speaks for a pose that submaps hold
        to be certain: what is missing is what has changed.
    """

    testimonies: int = 4
    trusted_standing_fit: float = 0.6
    fitting_hits: float = 0.7
    suspicious_gone: float = 0.25
    wrong_hits: float = 0.5
    wrong_share: float = 0.6
    stale_share: float = 0.35
    poor_sigma_m: float = 0.15
    poor_sigma_rad: float = 0.003
    least_standing: int = 25
    least_known: float = 0.3
    motion_gap_s: float = 0.3
    gap_s: float = 2.0
    lost_gap_s: float = 15.0
    longest_s: float = 15.0
    partly_matched: float = 0.3
    lost_sigma_m: float = 1.0

    def __post_init__(self) -> None:
        if min(self.testimonies, self.least_standing) < 1 or min(self.poor_sigma_m, self.poor_sigma_rad) <= 0:
            raise ValueError(f"counts and sigmas must be positive, got {self}")
