"""How long the stages of an import take: python tests/importer/measure_import_stages.py RECORDING DRIVE."""

import sys
import time
from pathlib import Path
from typing import Any

from gnd.vehicle_agent import importer
from gnd.vehicle_agent.importers.recording import RecordingAnchor

STAGES = ("levelled", "_with_times", "lidar_odometry", "with_mount", "check_track", "write_drive", "quality_of")


def timed(name: str) -> Any:
    """The stage, printing its seconds."""
    stage = getattr(importer, name)

    def run(*arguments: Any, **named: Any) -> Any:
        begin = time.monotonic()
        result = stage(*arguments, **named)
        print(f"{name}: {time.monotonic() - begin:.1f} s", flush=True)
        return result

    return run


if __name__ == "__main__":
    for name in STAGES:
        setattr(importer, name, timed(name))
    importer.import_recording("auto", Path(sys.argv[1]), Path(sys.argv[2]), anchor=RecordingAnchor(49.0, 8.4, 116.0))
