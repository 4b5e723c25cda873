"""What cannot be measured on a recording."""

from gnd.gnd_map.errors import GndError


class RealDataError(GndError):
    """A recording, or a choice of options, on which nothing can be measured."""
