"""The messages of a kilometre are really said, over a router, with seals and TLS."""

from pathlib import Path

import pytest

from gnd.deploy.fleet_identities import make_identities
from studies.security_study.kilometre import KILOMETRE, KilometreMessage, router, wired

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_each_message_passes_the_vehicle_s_connection(tmp_path: Path, protocol: str) -> None:
    identities = make_identities(tmp_path, 1, 1)
    with (
        router(protocol, identities) as (port, _),
        wired(f"{protocol}/127.0.0.1:{port}", identities if protocol == "tls" else None) as parts,
    ):
        parts.bytes_of((KILOMETRE[0], KILOMETRE[3]))
        for what in ("question", "report", "word", "telemetry"):
            small, large = (parts.bytes_of((KilometreMessage(what, 200, 100 * n),)) for n in (1, 9))
            assert small > 200 * (what != "word") + 52
            if what in ("question", "word"):
                assert 700 < large - small < 1100
