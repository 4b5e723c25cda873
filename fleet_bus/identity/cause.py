"""Why a connection over TLS does not come about: zenoh only says "unable to connect", the handshake itself says more.

The same endpoint is tried with the same identity by Python's ssl, and what comes back is put into words.
"""

import datetime as dt
import socket
import ssl
from pathlib import Path
from typing import Final

from gnd.fleet_bus.errors import IdentityError

PROBE_S: Final = 3.0
_ANSWER_S: Final = 1.0
"""In TLS 1.3 a server refuses a client's certificate only after the handshake: so long it is listened to."""
_ALERTS: Final = {
    "CERTIFICATE_EXPIRED": "our certificate counts as expired or not yet valid there: compare both clocks",
    "UNKNOWN_CA": "our certificate does not come from the authority that is trusted there",
    "DECRYPT_ERROR": "our certificate is not signed by the authority of that name that is trusted there",
    "CERTIFICATE_REVOKED": "our certificate has been revoked",
    "CERTIFICATE_REQUIRED": "a certificate is asked for there",
    "BAD_CERTIFICATE": "our certificate is refused there",
    "CERTIFICATE_UNKNOWN": "our certificate is refused there",
    "UNSUPPORTED_CERTIFICATE": "our certificate is refused there: it is not one for clients",
}
# X509_V_ERR_... of OpenSSL's x509_vfy.h
_NOT_YET_VALID, _EXPIRED, _SELF_SIGNED, _FOREIGN, _WRONG_HOST, _WRONG_ADDRESS = 9, 10, (18, 19), (2, 20, 21), 62, 64


def why_not(endpoint: str, folder: Path) -> str:
    """The cause for which `endpoint` ("tls/host:port") cannot be connected to with the identity in `folder`.

    A sentence; "" where the handshake succeeds, so that the cause lies elsewhere.
    """
    from gnd.fleet_bus.identity.folder import load_identity, problems

    try:
        found = problems(load_identity(folder))
    except IdentityError as error:
        return str(error)
    return "; ".join(found) or _by_handshake(endpoint, folder)


def _by_handshake(endpoint: str, folder: Path) -> str:
    host, _, port = endpoint.partition("/")[2].partition("#")[0].rpartition(":")
    host = host.strip("[]")
    try:
        with socket.create_connection((host, int(port)), PROBE_S) as plain:
            return _handshake(plain, host, folder)
    except ConnectionRefusedError:
        return f"nothing listens at {endpoint}"
    except TimeoutError:
        return f"no answer from {endpoint} within {PROBE_S:g} s"
    except socket.gaierror as error:
        return f"{host} cannot be resolved: {error.strerror}"
    except OSError as error:
        return f"{endpoint} cannot be reached: {error.strerror or error}"


def _handshake(plain: socket.socket, host: str, folder: Path) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(folder / "authority.pem")
    context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")
    try:
        with context.wrap_socket(plain, server_hostname=host) as end:
            end.settimeout(_ANSWER_S)
            end.recv(1)  # nothing comes where all is well: the other side waits for us
    except TimeoutError:
        return ""
    except ssl.SSLCertVerificationError as error:
        return _of_their_certificate(error, host)
    except ssl.SSLError as error:
        return _of_alert(error)
    except OSError:
        return "the connection is ended there in the middle of the handshake: no TLS, or the certificate is refused"
    return "the connection is ended there right after the handshake"


def _of_their_certificate(error: ssl.SSLCertVerificationError, host: str) -> str:
    now = f"{dt.datetime.now(dt.UTC):%Y-%m-%d %H:%M:%S} UTC"
    code = error.verify_code
    if code == _NOT_YET_VALID:
        return f"the router's certificate is not yet valid by this machine's clock ({now}): is the clock wrong?"
    if code == _EXPIRED:
        return f"the router's certificate has expired by this machine's clock ({now})"
    if code in (*_SELF_SIGNED, *_FOREIGN):
        return "the router's certificate does not come from our authority"
    if code in (_WRONG_HOST, _WRONG_ADDRESS):
        return f"the router's certificate is not for the name {host}: `gnd certs router --host {host}`"
    return f"the router's certificate is not accepted: {error.verify_message}"


def _of_alert(error: ssl.SSLError) -> str:
    reason = (error.reason or str(error)).upper()
    for alert, meaning in _ALERTS.items():
        if alert in reason:
            return meaning
    if "WRONG_VERSION_NUMBER" in reason or "RECORD_LAYER" in reason or "UNEXPECTED_EOF" in reason:
        return "there is no TLS at that port"
    return f"the handshake fails: {error.reason or error}"
