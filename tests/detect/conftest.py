"""The tests of detection share the small place of the vehicle's tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "vehicle_agent"))
