"""Peers' times in units of ours, as `gnd bench agent` tells them."""

import statistics
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from studies.speed.contest import Contest, Entrant, times_ms
from studies.speed.matching import matching_contest
from studies.speed.rays import kernel_contest, scan_contest
from studies.speed.scene import SpeedOptions, scene_of

SENSOR: Final = "HDL-32E"
_SHORT: Final = {"C (": "c", "OctoMap": "octomap", "DUFOMap": "dufomap", "small_gicp VGICP": "vgicp"}


def ratios(rounds: int) -> dict[str, float]:
    """The median over the rounds of a peer's CPU time by ours: `c` (the ray kernel by gcc), `octomap` and `dufomap`
    (whole scans), `vgicp` (a scan on a map); those that are not installed are left out.
    """
    found: dict[str, float] = {}
    options = SpeedOptions(rounds=rounds)
    with TemporaryDirectory() as folder:
        scene = scene_of(options, SENSOR, Path(folder))
        for contest in (kernel_contest(scene, Path(folder)), scan_contest(scene), matching_contest(scene)):
            found |= _of_contest(contest, rounds)
    return found


def _of_contest(contest: Contest, rounds: int) -> dict[str, float]:
    peers = {key: one for one in contest.others for name, key in _SHORT.items() if one.name.startswith(name)}
    runners = {key: one for key, one in peers.items() if isinstance(one, Entrant)}
    for one in (contest.ours, *runners.values()):
        one.work()  # once before, for caches and compilers
    taken_ms = times_ms([contest.ours, *runners.values()], rounds, contest.units)
    ours_ms = taken_ms[contest.ours.name]
    return {
        key: statistics.median(own / ours for own, ours in zip(taken_ms[one.name], ours_ms, strict=True))
        for key, one in runners.items()
    }
