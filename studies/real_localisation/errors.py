"""What cannot be measured."""

from gnd.gnd_map.errors import GndError


class RealLocalisationError(GndError):
    """A folder in which nothing can be measured, or that is damaged."""
