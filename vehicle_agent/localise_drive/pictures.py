"""The pictures of a localised drive."""

from pathlib import Path

from gnd.vehicle_agent.localise.estimates import error_series
from gnd.vehicle_agent.localise_drive.curves import draw_errors, draw_quality
from gnd.vehicle_agent.localise_drive.map_picture import draw_map
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive
from gnd.vehicle_agent.tiles_at_hand import TileSource


def draw_pictures(drive: LocalisedDrive, tiles: TileSource, folder: Path) -> list[Path]:
    """Draw map.png, quality.png, and errors.png where there are poses and a reference; give the paths.

    Raises:
        LocaliseError: a file cannot be written.
        StoreError: a tile cannot be read again.
    """
    drawn = [draw_map(drive, tiles, folder / "map.png"), draw_quality(drive, folder / "quality.png")]
    if len(error_series(drive.online, drive.reference)):
        drawn.append(draw_errors(drive, folder / "errors.png"))
    return drawn
