"""The agent: a recorded drive, a pipeline, and the link to the cloud. The vehicle on one page is `pipeline.py`."""

import threading
from typing import Any

from gnd.fleet_bus.settings_file import write_settings
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.memory import keep_small, keep_what_is_loaded
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
    with open_vehicle(config, stop) as vehicle:  # link to the cloud, tiles, outbox, and the pipeline between them
        keep_what_is_loaded()
        for item in vehicle.drive():  # recording -> measurements in time order
            vehicle.push(item)  # download, localise, segment, detect, report: see `Pipeline.push`
        vehicle.finish()  # what waits in the lags -> the last reports
        vehicle.upload()  # outbox -> acknowledged
        result = vehicle.result()
    result["traffic"] = vehicle.link.traffic()  # the link is closed: nothing comes after it
    result["settings_sha256"] = write_settings(config, config.work_dir)
    write_json(config.work_dir / "result.json", result)
    if vehicle.damage is not None:
        raise vehicle.damage
    return result
