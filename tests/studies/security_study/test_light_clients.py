"""Light clients open real sessions: a router accepts what they say, and only with its own cookie."""

from pathlib import Path

import pytest

from gnd.deploy.fleet_identities import make_identities
from studies.security_study.kilometre import router
from studies.security_study.light_clients import _open, _tls_context, cpu_of_s, open_sessions, record_opening


def test_a_router_accepts_light_clients(tmp_path: Path) -> None:
    identities = make_identities(tmp_path, 1, 1)
    with router("tcp", identities) as (plain, _), router("tls", identities) as (port, process):
        opening = record_opening(plain)
        found = open_sessions(opening, port, identities / "vehicle-00", 6)
        assert found.sessions == 6
        assert 0 < found.clients_cpu_s / found.sessions < 0.1
        assert cpu_of_s(process) > 0
        context = _tls_context(identities / "vehicle-00")
        for link in (_open(opening, port, context), _open(opening, plain, None)):
            link.close()
        with pytest.raises(OSError, match=r".*"):  # no TLS, no session
            _open(opening, port, None)
        forged = type(opening)(opening.init, opening.zid, opening.before_cookie + b"\x01", opening.after_cookie)
        with pytest.raises(OSError, match=r".*"):
            _open(forged, port, context)
