"""A member hears which certificates its authority has taken back, and keeps the list in its identity folder."""

import logging
from pathlib import Path

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.rights import REVOKED_KEY

_LOG = logging.getLogger(__name__)


def follow_revoked(bus: Bus) -> None:
    """Keeps `revoked.pem` of this process's identity up to date while the bus is open; nothing without an identity."""
    folder = bus.config.identity
    if folder is None:
        return

    def note(_key: str, payload: bytes) -> None:
        try:
            take_revoked(folder, payload)
        except (IdentityError, OSError) as error:
            _LOG.warning("a list of the revoked is not taken: %s", error)

    bus.subscribe(REVOKED_KEY, note, kind="control")


def take_revoked(folder: Path, data: bytes) -> bool:
    """Puts a list of the revoked into an identity folder, if it is newer; whether it was.

    Raises:
        IdentityError: damaged, or not signed by the folder's authority.
    """
    from gnd.fleet_bus.identity.folder import REVOKED, load_identity
    from gnd.fleet_bus.identity.lists import load_revoked, replace_file, revoked_number

    authority, path = load_identity(folder).authority, folder / REVOKED
    new = revoked_number(load_revoked(data, authority))
    if path.exists() and new <= revoked_number(load_revoked(path.read_bytes(), authority)):
        return False
    replace_file(path, data)
    return True
