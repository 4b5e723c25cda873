"""The settings of one agent; the defaults run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, get_args

from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.fleet_bus.links import LinkProfile
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.feature_layer import LayerParameters
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.sources.world_clock import Departure

LocaliseBy = Literal["lidar", "slamcu", "graph"]
"""By scans on the voxel map; or, without LiDAR, by a particle filter of motion, GNSS and the features of one layer
(SLAMCU), or by one graph of motion, GNSS, features and lanes for each stretch (the new-feature-layer paper)."""

LEAD_S: Final = 6.0
"""A question is sent when something is needed within this time; with it goes all that is ahead."""

DEFAULT_NAME: Final = "vehicle"
PRIVATE_M: Final = 300.0
"""Radius of the private places of a vehicle with pseudonyms that sets none."""
PRIVATE_OFF: Final = 0.75
"""Begins and ends within this share of a private place's radius from its centre belong to it."""
PRIVATE_SEEN_M: Final = 60.0
"""A tile so far outside of a private place is not told of, either: the vehicle has seen it from inside."""


@dataclass(frozen=True, slots=True)
class DownloadParameters:
    """Which tiles are asked for, and how patiently."""

    near_m: float = setting(
        60.0,
        "Tiles this near are held in memory, and needed now: beyond the range of detection.",
        unit="m",
        above=0,
    )
    ahead_m: float = setting(
        120.0, "How far along the heading tiles are asked for in advance, at least.", unit="m", least=0
    )
    in_flight: int = setting(8, "Requests at a time; one at a time leaves a 5G link at 15 %.", least=1, most=64)
    request_s: float = setting(20.0, "Time for one request, its retries included.", unit="s", above=0)
    wait_s: float = setting(
        30.0,
        "A drive that is not paced waits this long for a tile that is near; then it goes on without.",
        unit="s",
        least=0,
    )
    forget_m: float = setting(
        90.0,
        "Tiles farther away leave the memory (not the cache) once their evidence is reported; at least `near_m`.",
        unit="m",
        above=0,
    )

    def __post_init__(self) -> None:
        """Distances in order, at least one request in flight."""
        check_settings(self, AgentConfigError)
        if self.near_m > self.forget_m:
            raise AgentConfigError(f"near_m = {self.near_m} m must not exceed forget_m = {self.forget_m} m")


@dataclass(frozen=True, slots=True)
class ReportParameters:
    """When a tile is left, when a report is sent, which poses may make statements."""

    longest_m: float = setting(400.0, "Any change is reported at the latest after this much way ...", unit="m", least=0)
    longest_s: float = setting(
        40.0,
        "... or time. Such a report costs 0.3 to 0.5 kB with its answers: 20 s at 40 km/h would be 2 kB/km.",
        unit="s",
        least=0,
    )
    unchanged_m: float = setting(
        1000.0,
        "Ground that is unchanged: reported at the latest after this much way (at least `longest_m`) ...",
        unit="m",
        least=0,
    )
    unchanged_s: float = setting(120.0, "... or time; at least `longest_s`.", unit="s", least=0)
    protocol: Literal["packed", "full"] = setting(
        "packed",
        "How reports are sent: in short (flags and track first, then the Gaussians asked for), or at once and whole.",
    )
    max_sigma_m: float = setting(
        0.15,
        "Scans whose refined position is less certain (in its worst direction) are no evidence.",
        unit="m",
        above=0,
    )
    max_sigma_rad: float = setting(
        0.02, "The same for the attitude: about its worst axis, 40 cm at 20 m.", unit="rad", above=0
    )
    private_m: float = setting(
        0.0,
        "Nothing is told of places nearer than this to where a trip begins and ends, of its position, and of its begin"
        " to the second; 0: all is told. A vehicle with pseudonyms that sets none keeps 300 m.",
        unit="m",
        least=0,
        most=20_000,
    )
    check_poses: bool = setting(
        True, "Scans are evidence only once no small shift lays them better onto the map; off only for studies."
    )
    drain_s: float = setting(
        120.0,
        "At the end of a drive the agent waits this long for its reports to be acknowledged.",
        unit="s",
        least=0,
    )

    @property
    def hold_m(self) -> float:
        """What lies nearer than this could lie in the private place where the trip ends; 0: nothing is private."""
        return (1 + PRIVATE_OFF) * self.private_m + PRIVATE_SEEN_M if self.private_m else 0.0

    def __post_init__(self) -> None:
        """A protocol that there is, and waiting times in order."""
        check_settings(self, AgentConfigError)
        if self.longest_s > self.unchanged_s:
            raise AgentConfigError(f"longest_s = {self.longest_s}, unchanged_s = {self.unchanged_s} s must rise")
        if self.longest_m > self.unchanged_m:
            raise AgentConfigError(f"longest_m = {self.longest_m}, unchanged_m = {self.unchanged_m} m must rise")
        if self.protocol not in ("packed", "full"):
            raise AgentConfigError(f"protocol = {self.protocol!r}: there are 'packed' and 'full'")


@dataclass(frozen=True, slots=True)
class LiveParameters:
    """Where a vehicle that drives now gets its measurements (`--live`)."""

    source: Literal["", "ros2", "zenoh"] = setting(
        "", "Topics of ROS 2 over rmw_zenoh, or the plain keys of `gnd play --zenoh`; empty: a recording is driven."
    )
    connect: tuple[str, ...] = setting((DEFAULT_ENDPOINT,), "Endpoints of the router of the vehicle's own sensors.")
    domain: int = setting(0, "ROS_DOMAIN_ID.", least=0, most=232)
    points: str = setting("", "Topic of the LiDAR's sweeps; the only one of its type where it is not named.")
    gnss: str = setting("", "Topic of positions; likewise.")
    speed: str = setting("", "Topic whose twist gives speed and yaw rate: Odometry or TwistStamped; likewise.")
    imu: str = setting("", "Topic of a gyro that gives the yaw rate instead; empty: none.")
    vehicle_frame: str = setting("", "Frame of the vehicle, x forward; empty: base_footprint, base_link, ...")
    mount: tuple[float, ...] = setting(
        (), "Of the LiDAR in the vehicle: x, y, z (m), roll, pitch, yaw (deg); empty: as /tf_static gives it."
    )
    silent_s: float = setting(0.0, "The drive ends once nothing has come for so long; 0: never.", unit="s", least=0)

    def __post_init__(self) -> None:
        """Numbers that can be."""
        check_settings(self, AgentConfigError)
        if len(self.mount) not in (0, 6):
            raise AgentConfigError(f"live.mount = {list(self.mount)}: x, y, z, roll, pitch, yaw are needed")


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

    The ledger goes to `ledger_dir`, by default the folder `ledger` beside `work_dir`. Two are no settings: `departure`,
    where several vehicles drive in one world, when this one starts, and the clock that they share; and `pseudonyms`,
    the folder that the vehicle's present name comes from, None where it always has the same.
    """

    vehicle: str = setting(..., "Pseudonym of the vehicle.")
    drive: Path | None = setting(..., "Recording (MCAP) to drive; none where the vehicle drives now.")
    work_dir: Path = setting(..., "Folder of cache, outbox and result.")
    connect: tuple[str, ...] = setting((DEFAULT_ENDPOINT,), "Endpoints of routers, tried in order.")
    tiles_from: str = setting(
        "", "Archive on a web server (`gnd map publish`) that brings tiles first; the bus adds what is newer."
    )
    link: str | LinkProfile = setting("none", "Mobile link to feel: 3g, 4g, 5g, none or a TOML file.")
    layer: str = setting("ndt", "Layer of the voxel map.")
    pace: float = setting(
        0.0, "Speed of the drive: 1 in real time, 0 as fast as the recording can be worked on.", least=0
    )
    open_timeout_s: float = setting(
        10.0,
        "The agent waits this long for a router when it starts; then it drives without, on its cache.",
        unit="s",
        least=0,
    )
    departure: Departure | None = None
    pseudonyms: Path | None = None
    ledger_dir: Path | None = setting(None, "Folder of the traffic ledger; by default `ledger` beside `work_dir`.")
    live: LiveParameters = setting(LiveParameters, "Topics of a vehicle that drives now.")
    localise: LocaliserParameters = setting(LocaliserParameters, "Localisation.")
    segment: SegmentParameters = setting(SegmentParameters, "Segmentation of what moves.")
    detect: DetectParameters = setting(DetectParameters, "Detection of changes.")
    download: DownloadParameters = setting(DownloadParameters, "Download of tiles.")
    report: ReportParameters = setting(ReportParameters, "Reports.")
    features: FeatureParameters = setting(FeatureParameters, "Feature layers.")
    feature_layer: tuple[LayerParameters, ...] = setting(
        (),
        "Feature layers that the user declares, beside signs, streetlights and poles; agents, shards and the tile"
        " server read the same tables.",
    )
    localise_by: LocaliseBy = setting(
        "lidar",
        "Scans on the voxel map; or, without LiDAR, a particle filter of motion, GNSS and the features of one layer"
        " (slamcu), or one graph of motion, GNSS, features and lanes for each stretch (graph).",
    )

    def __post_init__(self) -> None:
        """A name and a pace that can work."""
        check_settings(self, AgentConfigError)
        if (self.drive is None) == (not self.live.source):
            raise AgentConfigError("one of the two is needed: a recording (--drive FILE), or --live ros2|zenoh")
        if not self.vehicle:
            raise AgentConfigError("the vehicle needs a name (its pseudonym)")
        if is_feature_layer(self.layer):
            raise AgentConfigError(f"layer = {self.layer!r} holds features; that of the voxel map begins with ndt")
        if self.localise_by not in get_args(LocaliseBy):
            raise AgentConfigError(f"localise_by = {self.localise_by!r}: there are {', '.join(get_args(LocaliseBy))}")
        if self.localise_by != "lidar" and not self.features.layers:
            raise AgentConfigError("a vehicle without LiDAR maps features: name at least one feature layer")

    @property
    def private_file(self) -> Path:
        """Where the vehicle remembers its private places."""
        return (self.pseudonyms or self.work_dir) / "private_places.json"

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
        return self.pace == 0 and not self.live.source
