"""What the pipelines of vehicles without LiDAR have in common: place, health and reports, and no voxels."""

from collections import Counter

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate
from gnd.vehicle_agent.pipeline import HeldBack, Output
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report.sink import NewReports, ReportList, ReportSink
from gnd.vehicle_agent.result import HealthTimeline
from gnd.vehicle_agent.scans import Guard


class VehicleWithoutLidar:
    """One drive of one vehicle without LiDAR. Poses are in the map frame: ENU at the tile of the first position.

    Args:
        fix: the first position, which lays the map frame.
        outbox: where reports go; None: nowhere but into the `Output`.
        cause: of being lost before there is a pose.

    Attributes:
        place, guard, timeline: as of `Pipeline`.
        counts: of what was done, by name.
    """

    def __init__(self, fix: GnssFix, outbox: ReportSink | None, cause: Cause) -> None:
        frame = LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
        self.place, self.guard, self.timeline = Place(frame, fix), Guard(), HealthTimeline()
        self.counts: Counter[str] = Counter()
        self._new_reports = NewReports(ReportList() if outbox is None else outbox)
        self._online: PoseEstimate | None = None
        self._without_pose: tuple[Health, Cause] = ("lost", cause)

    @property
    def held_back(self) -> HeldBack:
        """There are no voxels to hold back."""
        return HeldBack()

    def tile(self, tile_id: TileId) -> Tile | None:  # noqa: ARG002  (a vehicle without a voxel map holds no tile of it)
        """None: there is no voxel map."""
        return None

    def _output(self, poses: tuple[PoseEstimate, ...] = ()) -> Output:
        online = self._online
        state = self._without_pose if online is None else (online.health, online.cause)
        return Output(poses, self._new_reports.take(), online, *state)
