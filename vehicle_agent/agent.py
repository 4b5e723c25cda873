"""The vehicle on one page (GND, Figure 1): drive, download, localise, segment, detect, report, upload.

Feature layers go the same way: `judge` is for them what `detect` and `report` are for voxels (SLAMCU, section 4).
"""

import threading
from typing import Any

from gnd.fleet_bus.settings_file import write_settings
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.memory import keep_small
from gnd.vehicle_agent.result import write_json
from gnd.vehicle_agent.vehicle import open_vehicle

__all__ = ["AgentConfig", "run_agent"]


def run_agent(config: AgentConfig, stop: threading.Event) -> dict[str, Any]:
    """Drive one recording to its end, upload what has changed, and wait for the acknowledgements.

    An agent that was killed is simply started again: its recording begins anew, its cache and outbox are kept, and
    reports that were acknowledged are not sent again. `stop` ends the drive early and in order; what is in the outbox
    then goes with the next start. A recording that is damaged on the way is reported as far as it goes, then raised.

    Returns:
        The content of `work_dir/result.json`.

    Raises:
        GndError: the recording, a file or the bus cannot be used; the message says which and what to do.
    """
    keep_small()
    if config.localise_by == "graph":  # no LiDAR: features are mapped stretch by stretch
        from gnd.vehicle_agent.features.mapping.mapper import run_mapper

        return run_mapper(config, stop)
    with open_vehicle(config, stop) as vehicle:
        for item in vehicle.drive():  # recording -> usable measurements in time order
            if isinstance(item, Scan):
                vehicle.download()  # position -> the tiles around and ahead, and what others changed
            vehicle.look(item)  # what a camera detects waits for its pose
            for refined in vehicle.localise(item):  # measurements + tiles -> scans with final poses
                for scan in vehicle.segment(refined):  # rays against rays of other scans -> which points are movers
                    vehicle.detect(scan)  # rays + tiles -> evidence and new Gaussians
                    vehicle.report(scan)  # tiles left behind -> classes -> one report a district -> outbox
                    vehicle.judge(scan)  # looks + feature tiles -> what exists, is gone, is new -> outbox
        for scan in vehicle.segment_the_rest():
            vehicle.detect(scan)
            vehicle.judge(scan)
        vehicle.report_the_rest()
        vehicle.upload()  # outbox -> acknowledged
        result = vehicle.result()
    result["traffic"] = vehicle.link.traffic()  # the link is closed: nothing comes after it
    result["settings_sha256"] = write_settings(config, config.work_dir)
    write_json(config.work_dir / "result.json", result)
    if vehicle.damage is not None:
        raise vehicle.damage
    return result
