"""A process notices that its certificate ends, and that a new one lies in its folder."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.folder import CERTIFICATE, MemberIdentity, load_identity

LOOK_S: Final = 5.0
_SAY_S: Final = 3600.0
ILL_LEFT: Final = 1 / 20
"""A process with less than this share of its certificate's time left is ill."""
_LOG = logging.getLogger(__name__)


class CertificateWatch:
    """Looks at the folder every few seconds, in a thread, until closed.

    Args:
        folder: the identity folder.
        on_renewed: called when another certificate has come; what it raises is logged.
        name: of the process, for the log.
        every_s: how often to look, s.

    Raises:
        IdentityError: the folder cannot be used now.
    """

    def __init__(
        self, folder: Path, on_renewed: Callable[[MemberIdentity], None], name: str, every_s: float = LOOK_S
    ) -> None:
        self._folder, self._on_renewed, self._name, self._every_s = folder, on_renewed, name, every_s
        self.identity = load_identity(folder)
        self._stamp = _stamp(folder)
        self._said_s = float("-inf")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"certificate {name}", daemon=True)
        self._thread.start()

    def left_s(self) -> float:
        """How long the certificate in use holds, s."""
        return self.identity.left_s()

    def check(self) -> str | None:
        """For a health page: what is wrong, None = nothing."""
        left_s, whole_s = self.left_s(), (self.identity.ends - self.identity.begins).total_seconds()
        if left_s < ILL_LEFT * whole_s:
            return f"certificate {self.identity.member.common_name} {_ends(left_s)}: renew it (`gnd certs renew`)"
        return None

    def close(self) -> None:
        """Looks no more."""
        self._ended.set()

    def _run(self) -> None:
        self._warn()
        while not self._ended.wait(self._every_s):
            try:
                self._look()
            except Exception:
                _LOG.exception("%s: cannot look at %s", self._name, self._folder)
            self._warn()

    def _look(self) -> None:
        stamp = _stamp(self._folder)
        if stamp == self._stamp:
            return
        try:
            new = load_identity(self._folder)
        except IdentityError as error:
            _LOG.warning("%s: the new certificate is not used: %s", self._name, error)
            return  # the key may not be there yet: look again
        self._stamp = stamp
        if new.certificate != self.identity.certificate:
            self.identity = new
            _LOG.info("%s: certificate renewed until %s", self._name, new.ends.isoformat())
            self._on_renewed(new)

    def _warn(self) -> None:
        if self.identity.ends_soon() and time.monotonic() - self._said_s >= _SAY_S:
            self._said_s = time.monotonic()
            _LOG.warning(
                "%s: certificate %s in %s %s: renew it (`gnd certs renew`)",
                self._name,
                self.identity.member.common_name,
                self._folder,
                _ends(self.left_s()),
            )


def _ends(left_s: float) -> str:
    return f"ends in {left_s / 3600:.1f} h" if left_s >= 0 else f"has ended {-left_s / 3600:.1f} h ago"


def _stamp(folder: Path) -> tuple[int, int]:
    try:
        found = (folder / CERTIFICATE).stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_ino
