"""What starting a vehicle's code costs on this machine: `python -m gnd.ahead.start`, as a line of JSON.

Imports what a vehicle needs and calls all its kernels once. With GND_KERNELS=numba: without the library; with an empty
NUMBA_CACHE_DIR beside it: as on a machine that has compiled nothing yet. Times are the processor's.
"""

import importlib
import json
import sys
import time

from gnd.gnd_map.jit import kernels

_VEHICLE = "gnd.vehicle_agent.agent"
_WARM = "gnd.vehicle_agent.warm"


def started() -> dict[str, object]:
    """Start, and tell seconds, memory in MB (1e6 bytes), and how many kernels run whose machine code."""
    importlib.import_module(_VEHICLE)
    warm, memory = importlib.import_module(_WARM), importlib.import_module("gnd.vehicle_agent.memory")
    imported_s, imported_mb = time.process_time(), memory.resident_mb()
    warm.warm_up()
    made_by = [one.made_by for one in kernels()]
    return {
        "imports_s": round(imported_s, 2),
        "kernels_s": round(time.process_time() - imported_s, 2),
        "memory_mb": {"imports": round(imported_mb), "kernels": round(memory.resident_mb())},
        "kernels": {name: made_by.count(name) for name in ("ahead", "numba", "both")},
        "numba_loaded": "numba" in sys.modules,
    }


if __name__ == "__main__":
    print(json.dumps(started()))
