"""The run's summary names the vehicles that doubted themselves."""

from typing import Any

from gnd.deploy.account import FleetResults
from gnd.deploy.summary import doubtful_vehicles, summary_lines
from gnd.fleet_bus.traffic import fleet_totals

COUNTS = ("scans_shifted", "scans_taken_back", "tiles_doubtful", "tiles_held_back", "changes_held_back")
SHIFTED = {"tiles": {"explained_by_shift": 3}, "largest_shift_m": 0.213, "largest_turn_deg": 0.5}


def result(vehicle: str, *counts: int, **more: Any) -> dict[str, Any]:
    return {"vehicle": vehicle, **dict(zip(COUNTS, counts, strict=True)), **more}


def test_only_vehicles_with_doubts_are_named() -> None:
    sure = result("car-1", 0, 0, 0, 0, 0, doubts={"tiles": {}, "largest_shift_m": 0.0, "largest_turn_deg": 0.0})
    mapper = {"vehicle": "camera-1"}  # without LiDAR there is no gate
    doubtful = doubtful_vehicles(FleetResults((sure, result("car-2", 40, 5, 3, 3, 314, doubts=SHIFTED), mapper)))
    assert doubtful == {"car-2": dict(zip(COUNTS, (40, 5, 3, 3, 314), strict=True)) | SHIFTED}


def test_a_line_says_what_was_held_back_and_how_far_off_the_vehicle_was() -> None:
    summary: dict[str, Any] = {
        "agents": 2, "drive_km": 1.0, "link": "4g", "wall_s": 10.0, "tiles_downloaded": 5, "reports_sent": 2,
        "reports_acknowledged": 2, "reports_lost": 0, "tiles_published": 1, "updates_received": 1, "changed_voxels": 9,
        "traffic": fleet_totals([]),
        "localisation_p95": {"longitudinal_m": None}, "f1": {"before": None},
        "waiting_for_confirmation": {"tiles": 0, "voxels": 0, "parked": 0, "season": 0}, "named_vehicles": [],
        "doubtful": doubtful_vehicles(FleetResults((result("car-2", 40, 5, 3, 3, 314, doubts=SHIFTED),))),
    }  # fmt: skip
    assert (
        "car-2 doubts itself: 45 scans taken back, 3 tiles with 314 changes held back, 3 doubtful "
        "(3 explained by shift); largest shift 21 cm, 0.50 degrees"
    ) in summary_lines(summary)
