"""The settings of one agent; the defaults run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.fleet_bus.links import LinkProfile
from gnd.gnd_map.features import is_feature_layer
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.shift import ShiftParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.sources.world_clock import Departure

LocaliseBy = Literal["lidar", "slamcu", "graph"]
"""By scans on the voxel map; or, without LiDAR, by a particle filter of motion, GNSS and the features of one layer
(SLAMCU), or by one graph of motion, GNSS, features and lanes for each stretch (the new-feature-layer paper)."""


@dataclass(frozen=True, slots=True)
class DownloadParameters:
    """Which tiles are asked for, and how patiently."""

    near_m: float = 60.0
    """Tiles this near are held in memory, and needed now: beyond the range of detection."""
    ahead_m: float = 120.0
    """How far along the heading tiles are asked for in advance, at least."""
    ahead_s: float = 15.0
    """The same in time: a faster vehicle looks farther."""
    lead_s: float = 6.0
    """A question is sent when something is needed within this time; with it goes all that is ahead."""
    batch_s: float = 0.25
    """One answer holds what the link carries in this time (4 to 128 kB): something more urgent waits no longer."""
    link_share: float = 0.8
    """Part of the link's rate that the plan counts on."""
    in_flight: int = 8
    """Requests at a time; one at a time leaves a 5G link at 15 %."""
    request_s: float = 20.0
    """One request, its retries included."""
    retry_s: float = 1.0
    """Pause after a request that failed."""
    wait_s: float = 30.0
    """A drive that is not paced waits this long for a tile that is near; then it goes on without."""
    forget_m: float = 90.0
    """Tiles farther away leave the memory (not the cache) once their evidence is reported."""

    def __post_init__(self) -> None:
        """Distances in order, at least one request in flight."""
        if not 0 < self.near_m <= self.forget_m or self.ahead_m < 0:
            raise AgentConfigError(f"near_m = {self.near_m}, ahead_m = {self.ahead_m}, forget_m = {self.forget_m} m")
        if not 0 <= self.lead_s <= self.ahead_s:
            raise AgentConfigError(f"lead_s = {self.lead_s} s must lie between 0 and ahead_s = {self.ahead_s} s")
        if not (0 < self.link_share <= 1 and self.batch_s > 0):
            raise AgentConfigError(f"link_share = {self.link_share} (0 ... 1), batch_s = {self.batch_s} s")
        if not 1 <= self.in_flight <= 64:
            raise AgentConfigError(f"in_flight = {self.in_flight} lies outside 1 ... 64")


@dataclass(frozen=True, slots=True)
class ReportParameters:
    """When a tile is left, when a report is sent, which poses may make statements."""

    left_behind_m: float = 54.0
    """A tile farther from the vehicle gets no more evidence: its classes are decided. More than the range of detection
    by what the LiDAR stands from the vehicle's origin and what it drives during a scan."""
    soon_s: float = 0.3
    """Where much has changed, the report waits this long for tiles that are left together with the first ..."""
    soon_voxels: int = 48
    """... much: so many voxels of one tile. On ground that has not changed, detection errs in up to some 30."""
    apart_s: float = 3.0
    """Such reports follow each other no faster than this: a whole street that has changed shares a few."""
    longest_m: float = 400.0
    """Any change is reported at the latest after this much way ..."""
    longest_s: float = 40.0
    """... or time. Such a report costs 0.3 to 0.5 kB with its answers: 20 s at 40 km/h would be 2 kB/km."""
    unchanged_m: float = 1000.0
    """Ground that is as the map says it is: at the latest after this much way ..."""
    unchanged_s: float = 120.0
    """... or time."""
    protocol: Literal["packed", "full"] = "packed"
    """How reports are sent: in short (flags and track first, then the Gaussians asked for), or at once and whole."""
    max_sigma_m: float = 0.15
    """Scans whose refined position is less certain (in its worst direction) are no evidence."""
    max_sigma_rad: float = 0.02
    """The same for the attitude: about its worst axis, 40 cm at 20 m."""
    check_poses: bool = True
    """Scans are evidence only once no small shift lays them better onto the map; off for studies of what that costs."""
    shift: ShiftParameters = field(default_factory=ShiftParameters)
    """When a shift is one."""
    drain_s: float = 120.0
    """At the end of a drive the agent waits this long for its reports to be acknowledged."""

    def __post_init__(self) -> None:
        """A protocol that there is, and waiting times in order."""
        waits_s = (self.soon_s, self.apart_s, self.longest_s, self.unchanged_s)
        if waits_s[0] < 0 or sorted(waits_s) != list(waits_s) or self.soon_voxels < 1:
            raise AgentConfigError(
                f"soon_s, apart_s, longest_s and unchanged_s = {waits_s} s must rise from 0 on; soon_voxels ="
                f" {self.soon_voxels} must be 1 or more"
            )
        if not 0 <= self.longest_m <= self.unchanged_m:
            raise AgentConfigError(
                f"longest_m = {self.longest_m}, unchanged_m = {self.unchanged_m} m: 0 or more, rising"
            )
        if self.protocol not in ("packed", "full"):
            raise AgentConfigError(f"protocol = {self.protocol!r}: there are 'packed' and 'full'")


@dataclass(frozen=True, slots=True)
class PipelineParameters:
    """What a vehicle's algorithms go by."""

    localise: LocaliserParameters = field(default_factory=LocaliserParameters)
    segment: SegmentParameters = field(default_factory=SegmentParameters)
    detect: DetectParameters = field(default_factory=DetectParameters)
    report: ReportParameters = field(default_factory=ReportParameters)
    features: FeatureParameters = field(default_factory=FeatureParameters)


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """One vehicle agent.

    `pace` 0 drives as fast as the recording can be worked on, 1 in real time, 2 twice as fast. The ledger goes to
    `ledger_dir`, by default the folder `ledger` beside `work_dir`.
    """

    vehicle: str
    drive: Path
    work_dir: Path
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    link: str | LinkProfile = "none"
    layer: str = "ndt"
    pace: float = 0.0
    open_timeout_s: float = 10.0
    """How long the agent waits for a router when it starts; then it drives without, on its cache."""
    departure: Departure | None = None
    """Where several vehicles drive in one world: when this one starts, and the clock that they share."""
    ledger_dir: Path | None = None
    localise: LocaliserParameters = field(default_factory=LocaliserParameters)
    segment: SegmentParameters = field(default_factory=SegmentParameters)
    detect: DetectParameters = field(default_factory=DetectParameters)
    download: DownloadParameters = field(default_factory=DownloadParameters)
    report: ReportParameters = field(default_factory=ReportParameters)
    features: FeatureParameters = field(default_factory=FeatureParameters)
    localise_by: LocaliseBy = "lidar"
    """See `LocaliseBy`."""

    def __post_init__(self) -> None:
        """A name and a pace that can work."""
        if not self.vehicle:
            raise AgentConfigError("the vehicle needs a name (its pseudonym)")
        if is_feature_layer(self.layer):
            raise AgentConfigError(f"layer = {self.layer!r} holds features; that of the voxel map begins with ndt")
        if not 0 <= self.pace < float("inf"):
            raise AgentConfigError(f"pace = {self.pace}: 0 is as fast as possible, 1 real time")
        if self.localise_by not in get_args(LocaliseBy):
            raise AgentConfigError(f"localise_by = {self.localise_by!r}: there are {', '.join(get_args(LocaliseBy))}")
        if self.localise_by != "lidar" and not self.features.layers:
            raise AgentConfigError("a vehicle without LiDAR maps features: name at least one feature layer")
        if self.report.left_behind_m <= self.detect.range_max_m:
            raise AgentConfigError(
                f"left_behind_m = {self.report.left_behind_m} must exceed the range of detection,"
                f" {self.detect.range_max_m} m: a tile would be left while rays still reach it"
            )

    @property
    def ledger_path(self) -> Path:
        """The traffic ledger of this vehicle."""
        return (self.ledger_dir or self.work_dir.parent / "ledger") / f"{self.vehicle}.jsonl"

    @property
    def pipeline(self) -> PipelineParameters:
        """What the algorithms go by."""
        return PipelineParameters(self.localise, self.segment, self.detect, self.report, self.features)

    @property
    def waits_for_tiles(self) -> bool:
        """A drive that is not paced would otherwise outrun any link."""
        return self.pace == 0
