"""What an element of an OSM file is: by the tags of Lanelet2, and by OpenStreetMap's own of street furniture.

Sources: Lanelet2's LinestringsAndPolygonTagging.md and RegulatoryElementTagging.md; wiki.openstreetmap.org,
Key:highway, Key:traffic_sign, Key:man_made, Key:power.
"""

import re
from collections.abc import Mapping
from typing import Final

from gnd.gnd_map.features.feature import KIND_PATTERN

POINT_KINDS: Final = frozenset({"traffic_sign", "traffic_light", "pole", "streetlight"})
"""Whatever is drawn for these, the feature is one point: where it stands."""
BOUNDARIES: Final = frozenset(
    {
        "line_thin", "line_thick", "curbstone", "road_border", "guard_rail", "fence", "wall", "rail", "virtual",
        "keepout", "unknown", "jersey_barrier", "bike_marking", "pedestrian_marking",
    }
)  # fmt: skip
"""Types of linestrings that are borders of lanes."""
_SAME: Final = {
    "street_lamp": "streetlight",
    "street_light": "streetlight",
    "lamp": "streetlight",
    "lamp_post": "streetlight",
    "light_pole": "streetlight",
    "utility_pole": "pole",
    "traffic_signals": "traffic_light",
    "zebra_marking": "crosswalk",
}
_NATIVE: Final = (
    ("highway", "street_lamp", "streetlight"),
    ("highway", "traffic_signals", "traffic_light"),
    ("man_made", "utility_pole", "pole"),
    ("power", "pole", "pole"),
)
_NO_KIND: Final = re.compile(r"[^a-z0-9_]")
"""Lanelet2 has types such as "zig-zag"; the kind of the feature is zig_zag."""
POSITION_TAGS: Final = frozenset({"local_x", "local_y", "ele", "mgrs_code"})
"""Tags that say where an element is, not what."""


def kind_of(tags: Mapping[str, str], *, border: bool = False) -> str | None:
    """The kind of feature that an element is, or None; `border`: a lanelet names it as a border."""
    said = _NO_KIND.sub("_", tags.get("type", "").lower())
    kind = _SAME.get(said, said)
    if kind not in POINT_KINDS and (border or kind in BOUNDARIES):
        return "lane_boundary"
    if KIND_PATTERN.fullmatch(kind):
        return kind
    if "traffic_sign" in tags and not border:
        return "traffic_sign"
    return next((kind for key, value, kind in _NATIVE if tags.get(key) == value), None)


def told_of(tags: Mapping[str, str]) -> dict[str, str]:
    """The tags that become attributes of a feature."""
    return {key: value for key, value in tags.items() if key not in POSITION_TAGS}
