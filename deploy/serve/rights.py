"""Who looks at the page, and who may decide about changes.

Nobody may unless the command says so. Then it is whoever brings the page's token, or, where the page knows the
certificates of a fleet (`gnd certs`), whoever brings that of an operator; all other members only look.
"""

import datetime as dt
import getpass
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cryptography import x509
from uvicorn.protocols.http.h11_impl import H11Protocol

from gnd.deploy.errors import ServeError
from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.folder import AUTHORITY, REVOKED, certificates_in, member_of
from gnd.fleet_bus.identity.lists import load_revoked

PEER: Final = "certificate"
"""Where the state of a request holds the certificate that its connection has brought (DER)."""
DECIDES: Final = "operator"


@dataclass(frozen=True, slots=True)
class Viewer:
    """Somebody who asks.

    Attributes:
        name: for the record.
        is_member: whether a certificate of the fleet says so.
        may_decide: about changes of the map.
    """

    name: str
    is_member: bool
    may_decide: bool


class PageRights:
    """Who may do what.

    Args:
        allow_changes: whether anybody may decide about changes.
        roles: an identity folder, whose authority's certificates tell who is who; None: the token tells.

    Raises:
        ServeError: there is no authority in the folder.
    """

    def __init__(self, allow_changes: bool = False, roles: Path | None = None) -> None:
        self.allow_changes, self.roles = allow_changes, roles
        self._listed: tuple[int, frozenset[int]] = (0, frozenset())
        try:
            self._authority = () if roles is None else certificates_in(roles / AUTHORITY)
        except IdentityError as error:
            raise ServeError(f"--roles: {error}") from error

    @property
    def trusted(self) -> str | None:
        """File of the certificates whose members may come; None: nobody is asked for one."""
        return None if self.roles is None else str(self.roles / AUTHORITY)

    def viewer(self, state: dict[str, Any]) -> Viewer:
        """Who asks, by the state of a request whose connection has checked the certificate's issuer."""
        der = state.get(PEER)
        if self.roles is None or der is None:
            return Viewer(_user(), False, self.allow_changes and self.roles is None)
        try:
            certificate = x509.load_der_x509_certificate(der)
            member = member_of(certificate)
            if not self._holds(certificate):
                return Viewer(member.common_name, False, False)
        except (ValueError, IdentityError):
            return Viewer("somebody", False, False)
        return Viewer(member.common_name, True, self.allow_changes and member.role == DECIDES)

    def _holds(self, certificate: x509.Certificate) -> bool:
        """Whether it has neither ended since the connection began, nor been taken back."""
        now = dt.datetime.now(dt.UTC)
        is_now = certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc
        return is_now and certificate.serial_number not in self._revoked()

    def _revoked(self) -> frozenset[int]:
        """The serial numbers that the list in the folder names, read anew when the file is another."""
        assert self.roles is not None
        path = self.roles / REVOKED
        if not path.exists():
            return frozenset()
        changed_ns = path.stat().st_mtime_ns
        if changed_ns != self._listed[0]:
            listed = load_revoked(path.read_bytes(), self._authority)
            self._listed = changed_ns, frozenset(one.serial_number for one in listed)
        return self._listed[1]


class PeerProtocol(H11Protocol):
    """HTTP that tells the application which certificate a connection has brought."""

    def connection_made(self, transport: Any) -> None:
        """Look at the connection's certificate, which TLS has checked."""
        super().connection_made(transport)
        tls = transport.get_extra_info("ssl_object")
        self.app_state = {**self.app_state, PEER: None if tls is None else tls.getpeercert(binary_form=True)}


def _user() -> str:
    """Whoever runs this program, as the machine knows them."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        name = "somebody"
    return f"{name}@{socket.gethostname()}"
