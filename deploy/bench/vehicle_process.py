"""One vehicle in a process of its own, watched: `python -m gnd.deploy.bench.vehicle_process ASKED.json`.

It is the agent of `gnd agent`, with the same link to a router, only that its parts are timed. Nothing is imported
before its time, and no process was forked: start-up and memory are those of a vehicle that is alone.
"""

import time

_BEGUN_CPU_S = time.process_time()  # what the interpreter needed to come here

import json  # noqa: E402 - after the clock
import sys  # noqa: E402
import threading  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

if TYPE_CHECKING:
    from gnd.deploy.bench.stopwatch import Stopwatch
    from gnd.vehicle_agent.vehicle import AgentVehicle

READING = "reading the recording"


def parts() -> tuple[tuple[type, str, str], ...]:
    """What is timed: (class, method, stage)."""
    from gnd.gnd_map.accumulate import VoxelAccumulator
    from gnd.vehicle_agent.detect.detector import ChangeDetector
    from gnd.vehicle_agent.detect.trial import Trial
    from gnd.vehicle_agent.link.tiles_on_the_bus import TilesOnTheBus
    from gnd.vehicle_agent.localise.judge import Judge
    from gnd.vehicle_agent.localise.localiser import Localiser
    from gnd.vehicle_agent.localise.map_matcher import MapMatcher
    from gnd.vehicle_agent.localise.refine import Refiner
    from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry
    from gnd.vehicle_agent.memory import MemoryMeter
    from gnd.vehicle_agent.report.reporter import Reporter
    from gnd.vehicle_agent.segment.segmenter import MotionSegmenter
    from gnd.vehicle_agent.survey.surveyor import Surveyor

    return (
        (TilesOnTheBus, "follow", "tiles"),
        (Localiser, "push", "localisation, the rest"),
        (Localiser, "flush", "localisation, the rest"),
        (ScanOdometry, "step", "scan to scan"),
        (MapMatcher, "match", "scan to map"),
        (Judge, "see", "is the pose right"),
        (Refiner, "push", "refined poses"),
        (Refiner, "flush", "refined poses"),
        (MotionSegmenter, "push", "segmentation"),
        (MotionSegmenter, "flush", "segmentation"),
        (ChangeDetector, "add_scan", "rays"),
        (VoxelAccumulator, "add", "points"),
        (Trial, "take", "is the map shifted"),
        (Trial, "go_on", "is the map shifted"),
        (Trial, "flush", "is the map shifted"),
        (Reporter, "take", "reports"),
        (Reporter, "go_on", "reports"),
        (Reporter, "leave_behind", "reports"),
        (Reporter, "report_all", "reports"),
        (Surveyor, "push", "new roads"),
        (MemoryMeter, "count_scan", "memory meter"),
    )


def measured(asked: dict[str, Any]) -> dict[str, Any]:
    """Drive as `run_agent` does, with a watch on it.

    Args:
        asked: `settings` of the agent, as its settings file holds them.
    """
    start: dict[str, float] = {"interpreter": _BEGUN_CPU_S}
    compiled: list[float] = []
    from gnd.deploy.bench.stopwatch import Stopwatch
    from gnd.vehicle_agent.memory import keep_small, keep_what_is_loaded
    from gnd.vehicle_agent.settings import agent_of
    from gnd.vehicle_agent.vehicle import open_vehicle

    keep_small()
    _record_compiling(compiled)
    stopwatch = Stopwatch()
    for owner, method, stage in parts():
        stopwatch.watch(owner, method, stage)
    config = agent_of(asked["settings"], where="bench")
    start["imports"] = time.process_time()
    with open_vehicle(config, threading.Event()) as vehicle:
        keep_what_is_loaded()
        start["link, cache and recording"] = time.process_time()
        found = _driven(vehicle, stopwatch, start, compiled)
        result = vehicle.result()
    steps = dict(zip(start, [b - a for a, b in zip([0.0, *start.values()], start.values(), strict=False)], strict=True))
    return found | {
        "start_s": steps,
        "localisation": result["localisation"],
        "counts": {name: result[name] for name in ("changed_voxels", "rays", "moving_points")},
    }


def _driven(
    vehicle: "AgentVehicle", stopwatch: "Stopwatch", start: dict[str, float], compiled: list[float]
) -> dict[str, Any]:
    from gnd.deploy.bench.holders import holders_now_mb
    from gnd.schemas.drive import Scan
    from gnd.vehicle_agent.memory import resident_mb

    at_start_mb, peak_mb, first_ns, last_ns, at_once_s = resident_mb(), 0.0, 0, 0, 0.0
    begun_s = time.process_time()
    for item in stopwatch.timed(vehicle.drive(), READING):
        vehicle.push(item)
        first_ns, last_ns = first_ns or item.t_ns, item.t_ns
        if isinstance(item, Scan):
            if not stopwatch.scans:
                start["first scan"], at_once_s = time.process_time(), sum(compiled)
            stopwatch.lap()
            peak_mb = max(peak_mb, resident_mb())
    holders = holders_now_mb()
    vehicle.finish()
    stopwatch.lap()
    peak_mb = max(peak_mb, resident_mb())
    driven_s = time.process_time() - begun_s
    vehicle.upload()
    *laps, end = stopwatch.scans
    return {
        "drive_s": (last_ns - first_ns) / 1e9,
        "cpu_s": driven_s,
        "upload_cpu_s": time.process_time() - begun_s - driven_s,
        "scans": laps,
        "end": end,
        "compiling_s": {"all": sum(compiled), "later": sum(compiled) - at_once_s},
        "memory_mb": {"start": at_start_mb, "peak": peak_mb},
        "holders_mb": holders,
    }


def _record_compiling(seconds: list[float]) -> None:
    """Note how long each kernel takes that is compiled from here on, one within another counted once.

    Loads no numba: a vehicle whose kernels were compiled ahead of time needs none.
    """
    from gnd.gnd_map.jit import when_numba_loads

    when_numba_loads(lambda: _listen(seconds))


def _listen(seconds: list[float]) -> None:
    from numba.core import event

    class Outermost(event.Listener):
        """Times a compilation that no other is waiting for."""

        def __init__(self) -> None:
            self.begun_s: list[float] = []

        def on_start(self, _begun: Any) -> None:
            """One begins."""
            self.begun_s.append(time.process_time())

        def on_end(self, _ended: Any) -> None:
            """One ends."""
            since_s = self.begun_s.pop()
            if not self.begun_s:
                seconds.append(time.process_time() - since_s)

    event.register("numba:compile", Outermost())  # type: ignore[no-untyped-call]  # numba has no types


def main() -> None:
    """See the module's head; what was measured goes to the file that `asked` names."""
    asked = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    Path(asked["out"]).write_text(json.dumps(measured(asked)), encoding="utf-8")


if __name__ == "__main__":
    main()
