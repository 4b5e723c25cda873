"""The names of the families, without what makes them."""

from typing import Final

FAMILY_NAMES: Final = (
    "street",
    "suburb",
    "avenue",
    "motorway",
    "snow",
    "car_park",
    "construction",
    "roundabout",
    "tunnel",
)
RESERVED: Final = ("car_park", "construction", "roundabout", "tunnel")
"""For tests only: no parameter and no model may be chosen by their worlds."""
