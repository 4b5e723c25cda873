"""What a vehicle drives on: a recording, or the sensors that are there now."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.sources.recording import first_fix, paced
from gnd.vehicle_agent.sources.world_clock import in_common_time

if TYPE_CHECKING:
    from gnd.vehicle_agent.sources.ros2 import RosSource

WAITED_NS: Final = 10_000_000_000
"""Before the first position, live measurements of the last so many nanoseconds are kept."""


@dataclass(frozen=True, slots=True)
class DriveSource:
    """Measurements of one drive, and what is known of it beforehand.

    Attributes:
        header: sensor, mount, what is known of the sweeps.
        fix: the first position.
        items: all measurements in the order of their times, that position among them.
        account: what came and what did not, as plain values; {} for a recording.
        ros2: the graph that the vehicle is a node of; None: of none.
    """

    header: DriveHeader
    fix: GnssFix
    items: Iterator[DriveItem]
    account: Callable[[], dict[str, Any]] = dict
    ros2: "RosSource | None" = None


@contextmanager
def open_source(config: AgentConfig, stop: threading.Event) -> Iterator[DriveSource]:
    """Open the recording, or listen to the sensors until the first position has come.

    Raises:
        DriveError: the recording cannot be read.
        NoPlace: it does not tell where on the Earth it was recorded.
        VehicleError: it has no position to start from; or nobody measures what a vehicle needs (`LiveError`).
    """
    with ExitStack() as open_things:
        if config.drive is not None:
            header, (fix, items) = read_header(config.drive), first_fix(read_drive(config.drive), config.drive)
            header.check_placed()
            items = paced(items, config.pace, stop)
            yield DriveSource(header, fix, in_common_time(items, config.departure, stop))
        else:
            yield _live(config, stop, open_things)


def _live(config: AgentConfig, stop: threading.Event, open_things: ExitStack) -> DriveSource:
    from gnd.vehicle_agent.warm import warm_up  # loads every part of a vehicle

    warm_up()  # on a fresh machine kernels are compiled for a minute, in which a vehicle that drives would be blind
    if config.live.source == "zenoh":
        from gnd.vehicle_agent.sources.plain_keys import open_plain

        plain = open_things.enter_context(open_plain(config.live, config.vehicle, stop))
        fix, items = first_fix(plain.items.drive(stop, config.live.silent_s), "zenoh", most_ns=WAITED_NS)
        return DriveSource(_of_this_drive(plain.header, config.vehicle, fix), fix, items, plain.account)
    from gnd.vehicle_agent.sources.ros2 import open_ros2

    ros2 = open_things.enter_context(open_ros2(config.live, config.vehicle, stop))
    measured = ros2.items.drive(stop, config.live.silent_s)
    fix, items = first_fix(measured, f"ROS 2, {ros2.topics.gnss}", most_ns=WAITED_NS)
    header = DriveHeader(
        drive_id="live",
        vehicle=config.vehicle,
        sensor_model="unknown",
        anchor=LocalFrame(fix.lat_rad, fix.lon_rad, fix.height_m),
        T_vehicle_lidar=ros2.T_vehicle_lidar,
        source=f"ROS 2, {ros2.topics.points}",
        deskew="measured" if ros2.has_times else "none",
        mount="given",
    )
    return DriveSource(_of_this_drive(header, config.vehicle, fix), fix, items, ros2.account, ros2)


def _of_this_drive(header: DriveHeader, vehicle: str, fix: GnssFix) -> DriveHeader:
    """A header whose drive is named after the vehicle and its first position."""
    return replace(header, drive_id=f"{vehicle[:40]}-{fix.t_ns}", vehicle=vehicle)
