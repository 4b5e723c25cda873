"""Errors of the vehicle's half of the loop. Messages carry numbers and say what to do."""

from gnd.gnd_map.errors import GndError


class VehicleError(GndError):
    """Base of everything that `vehicle_agent` raises."""


class WindowTooLarge(VehicleError):
    """The tiles asked for do not fit a dense window of bounded memory."""


class MapChanged(VehicleError):
    """A tile was replaced or removed while evidence was gathered against it."""


class BadScan(VehicleError):
    """A scan that cannot be used; `state` names why (`empty`, `not-finite`, `constant`, `time-backwards`)."""

    def __init__(self, state: str, message: str) -> None:
        """Keeps the state for counting beside the message for people."""
        super().__init__(message)
        self.state = state


class CacheError(VehicleError):
    """The tile cache on disk cannot be opened or holds a tile that is not what its name says."""


class OutboxError(VehicleError):
    """The outbox cannot be opened or written; nothing may be reported without it."""


class PackingError(VehicleError):
    """A report that has no short form: a base tile is missing, or it holds more than flags can."""


class AgentConfigError(VehicleError):
    """The agent was started with values that cannot work."""


class LocaliseError(VehicleError):
    """Base of what localisation raises."""


class RegistrationError(LocaliseError):
    """A scan could not be matched with the map: too few of its points have a Gaussian nearby."""


class ImportDriveError(VehicleError):
    """A recording that cannot be read, or is not of the format that was named."""


class NewLayerError(VehicleError):
    """A drive that no feature layer can be made of: no motion, no position, or values that are not finite."""
