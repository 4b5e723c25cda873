"""`gnd reproduce`: the results of the papers, made again. Commands are imported when they are called."""

from typing import Final

import click

from gnd.deploy.cli import LazyGroup

_COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "simulation": (
        "studies.simulation.study:simulation",
        "The GND paper's simulation: worlds, single drives, fleets.",
    ),
    "paper-mode": (
        "studies.paper_mode.study:paper_mode",
        "The GND paper's own rules, with both readings of ξ, beside its Figures 15 to 17 and 23.",
    ),
    "localisation": (
        "studies.localisation_study.study:localisation",
        "Localisation in a changed world, before and after the map update.",
    ),
    "traffic": ("studies.traffic_study.study:traffic", "What a map and its changes weigh on the way (Figure 23)."),
    "steady-vehicle": (
        "studies.traffic_study.steady:steady_vehicle",
        "All bytes of a vehicle that knows its street, over the real bus.",
    ),
    "slamcu": (
        "studies.slamcu_study.study:slamcu",
        "Signs that have gone or are new, found by single cars: the SLAMCU paper.",
    ),
    "new-feature-layer": (
        "studies.new_layer_study.study:new_feature_layer",
        "A layer of beacons or lights mapped by many cars, and localisation with it.",
    ),
    "lanes": (
        "studies.lanes_study.study:lanes",
        "Borders of lanes mapped by vehicles, told as edits of a Lanelet2 map.",
    ),
    "hard-cases": (
        "studies.hard_cases.study:hard_cases",
        "Cases that make localisation fail: does the vehicle say when it is wrong?",
    ),
    "modified": (
        "studies.modified_study.study:modified",
        "Which voxels are modified: trees and thresholds, in places and by sensors that nothing was fitted on.",
    ),
    "trust": ("studies.trust_study.study:trust", "What bad vehicles can do to the map, and who is named for it."),
    "errors": ("studies.simulation.losses:errors", "Which voxels of a simulation cost F1, and why."),
    "real-localisation": (
        "studies.real_localisation.study:real_localisation",
        "Odometry, localisation and georeferencing on real recordings.",
    ),
    "release": (
        "studies.release_study.study:release",
        "Staged release: how soon a wrong tile is withdrawn, and how often a right one.",
    ),
    "new-road": ("studies.new_road.study:new_road", "Roads that the map does not have, mapped by vehicles."),
    "codec": (
        "studies.codec_study.study:codec",
        "What tiles weigh and what rounding does to poses, real and simulated.",
    ),
    "identity": (
        "studies.security_study.identity:identity",
        "What certificates cost a vehicle and a router, and how fast one is taken back.",
    ),
    "real": ("studies.real.study:real", "Detection on recordings of real sensors, with objects inserted."),
}


@click.group(cls=LazyGroup, table=_COMMANDS)
def reproduce() -> None:
    """Reproduce the papers' results and set ours beside them."""
