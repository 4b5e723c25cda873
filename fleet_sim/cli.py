"""The commands `gnd sim world`, `gnd sim drive` and `gnd sim road`; each is a thin layer over a library function."""

import json
from math import degrees
from pathlib import Path
from typing import Any

import click

from gnd.answers import json_option, tell
from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.fleet_sim.sensing import BEAMS, WEATHERS, Beams, Weather
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.street import SITES, StreetOptions, street
from gnd.fleet_sim.world import STATES, World, read_world, write_world
from gnd.fleet_sim.world_summary import as_text, summary


@click.group()
def sim() -> None:
    """Write and inspect simulated worlds and drives."""


@sim.group()
def world() -> None:
    """Worlds: a street before and after its changes."""


@world.command("write")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--seed", default=1, show_default=True, help="Seed of the street; the same seed gives the same world.")
@click.option("--length", "length_m", default=200.0, show_default=True, help="Length that is driven, 100 to 1000 m.")
@click.option("--site", type=click.Choice(SITES), default="border", show_default=True, help="Where the street lies.")
@click.option("--lat", "lat_deg", type=float, help="Latitude of its middle in degrees, instead of a site.")
@click.option("--lon", "lon_deg", type=float, help="Longitude of its middle in degrees, instead of a site.")
@click.option("--family", type=click.Choice(FAMILY_NAMES), default="street", show_default=True, help="Kind of place.")
@click.option("--parking", type=float, help="Share of parking slots that are taken on its drives, 0 to 1.")
@click.option("--edits", "edit_share", default=1.0, show_default=True, help="Share of the street's edits to make.")
@json_option
def write(file: Path, seed: int, as_json: bool, **options: Any) -> None:
    """Write the street of a seed to FILE (JSON)."""
    made = street(seed, StreetOptions(**options))
    write_world(made, file)
    line = f"{file}: {len(made.objects)} objects, {options['length_m']:g} m, {options['family']}, seed {seed}"
    tell({"file": file, "objects": len(made.objects), "seed": seed} | options, as_json, line)


@world.command("inspect")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def inspect(file: Path, as_json: bool) -> None:
    """Print the content of a world file: place, objects, edits by kind and by place along the street."""
    found = summary(read_world(file))
    click.echo(json.dumps(found) if as_json else as_text(found))


@world.command("picture")
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("png", type=click.Path(path_type=Path))
@click.option("--truth", "truth_file", type=click.Path(path_type=Path), help="Keep the truth in this file (.npz).")
@click.option(
    "--dpi", type=click.IntRange(40, 300), default=150, show_default=True, help="Dots an inch, of 12.6 inches."
)
@json_option
def picture(file: Path, png: Path, truth_file: Path | None, dpi: int, as_json: bool) -> None:
    """Draw what changes in the world of FILE, as classes of voxels (some 10 s for 200 m without a kept truth)."""
    from gnd.fleet_sim.ellipsoids import ellipsoids_of_truth
    from gnd.fleet_sim.pictures import draw_map
    from gnd.fleet_sim.truth import load_or_make_truth, make_truth

    made = read_world(file)
    truth = load_or_make_truth(made, truth_file) if truth_file else make_truth(made)
    draw_map(ellipsoids_of_truth(truth), png, f"World {made.seed}{_family(made)}", _note(made), dpi=dpi)
    counts = truth.counts("all")
    tell({"file": png, "voxels": counts}, as_json, f"{png}: {', '.join(f'{n} {name}' for name, n in counts.items())}")


@world.command("features")
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("layers", type=click.Path(path_type=Path))
@click.option("--mapped-streetlights", default=0.0, show_default=True, help="Share of the lamps that are in the map.")
@json_option
def features(file: Path, layers: Path, mapped_streetlights: float, as_json: bool) -> None:
    """Write the feature layers of the map before the changes of the world in FILE to LAYERS (JSON)."""
    from gnd.fleet_sim.feature_files import write_feature_layers
    from gnd.fleet_sim.feature_truth import base_features, feature_truth

    truth = feature_truth(read_world(file), mapped_streetlights)
    write_feature_layers(base_features(truth), layers)
    counts = truth.counts()
    lines = [f"{layer}: {', '.join(f'{n} {state}' for state, n in states.items())}" for layer, states in counts.items()]
    tell({"file": layers, "layers": counts}, as_json, *lines)


def _family(made: World) -> str:
    return "" if made.family == "street" else f", {made.family}"


def _note(made: World) -> str:
    lat_deg, lon_deg = degrees(made.lat_rad), degrees(made.lon_rad)
    return f"what changes between before and after on {2 * made.half_length_m:g} m at {lat_deg:.4f}°, {lon_deg:.4f}°"


@sim.command()
@click.argument("world_file", type=click.Path(path_type=Path))
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--sensor", default="VLP-16", show_default=True, help=f"{', '.join(SHORT_NAMES)}, or the model's name.")
@click.option("--state", type=click.Choice(STATES), default="after", show_default=True)
@click.option("--reverse", is_flag=True, help="Drive against the street's x.")
@click.option("--seed", default=0, show_default=True, help="Seed of everything random in the drive.")
@click.option("--vehicle", default="vehicle-0", show_default=True, help="Pseudonym of the vehicle.")
@click.option("--cars", type=float, help="Share of parking slots that are taken.  [default: the world's, usually 0.2]")
@click.option("--traffic", type=click.Choice(["none", "urban"]), default="none", show_default=True, help="Movers.")
@click.option("--weather", type=click.Choice(WEATHERS), default="clear", show_default=True)
@click.option("--beams", type=click.Choice(BEAMS), default="ideal", show_default=True, help="Real ones have a width.")
@click.option("--scans", type=int, help="At most so many scans.")
@click.option("--camera", is_flag=True, help="A camera that detects traffic signs, too.")
@json_option
def drive(
    world_file: Path,
    file: Path,
    sensor: str,
    state: str,
    reverse: bool,
    seed: int,
    vehicle: str,
    cars: float | None,
    traffic: str,
    weather: Weather,
    beams: Beams,
    scans: int | None,
    camera: bool,
    as_json: bool,
) -> None:
    """Drive through the world of WORLD_FILE and write what the sensors give to FILE (MCAP, opens in Foxglove)."""
    from gnd.fleet_sim.camera import SignCamera
    from gnd.fleet_sim.drives import DriveConfig, simulate_drive
    from gnd.fleet_sim.traffic import Traffic

    config = DriveConfig(
        vehicle=vehicle,
        sensor=SHORT_NAMES.get(sensor, sensor),
        state="before" if state == "before" else "after",
        direction=-1 if reverse else 1,
        seed=seed,
        car_share=cars,
        traffic=Traffic.urban() if traffic == "urban" else Traffic(),
        scans=scans,
        camera=SignCamera() if camera else None,
        weather=weather,
        beams=beams,
    )
    simulate_drive(read_world(world_file), config, file)
    size = file.stat().st_size
    tell({"file": file, "size_bytes": size}, as_json, f"{file}: {size / 1e6:.1f} MB")


@sim.group()
def road() -> None:
    """Roads of the feature studies: motorways and a test track, with the detections of a drive."""


@road.command("picture")
@click.argument("kind", type=click.Choice(["motorway", "test-track", "streetlights", "streetlights-straight"]))
@click.argument("png", type=click.Path(path_type=Path))
@click.option("--seed", default=11, show_default=True, help="Seed of the road.")
@click.option("--drive", "drive_seed", default=1, show_default=True, help="Seed of the drive.")
@json_option
def road_picture(kind: str, png: Path, seed: int, drive_seed: int, as_json: bool) -> None:
    """Draw a road of KIND and one drive along it to PNG."""
    from gnd.fleet_sim.roads.drive import drive_route
    from gnd.fleet_sim.roads.pictures import draw_drive
    from gnd.fleet_sim.roads.routes import route_named

    driven = drive_route(route_named(kind, seed), drive_seed)
    draw_drive(driven, png)
    detections, blind = sum(len(look) for look in driven.looks), int((driven.truth.looks_at == 0).sum())
    line = (
        f"{png}: {driven.route.length_m:.0f} m, {len(driven.looks)} looks, {detections} detections,"
        f" {blind} of {len(driven.route.features)} features hidden all the time"
    )
    values = {"length_m": driven.route.length_m, "looks": len(driven.looks), "detections": detections}
    values |= {"features": len(driven.route.features), "hidden": blind}
    tell({"file": png} | values, as_json, line)
