"""The way to the cloud: identity, router, who answers behind it, and what parts say of themselves."""

import http.client
import json
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from prometheus_client.parser import text_string_to_metric_families

from gnd.deploy.doctor.finding import Finding, State
from gnd.fleet_bus.build_info import BUILD, CLOCK, build_info
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import BusError, IdentityError
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import catalog_key
from gnd.tile_store.values import DEFAULT_LAYER

_OPEN_S: Final = 3.0
_ANSWER_S: Final = 3.0
_DAY_S: Final = 86_400.0
_OFF_S: Final = (1.0, 30.0)
_MOST_BYTES: Final = 4 << 20
_SOMEWHERE: Final = TileId.from_path("13033/03021/23031/22102")
_DECLARED_S: Final = 1.0


def cloud(connect: Sequence[str], identity: Path | None, pages: Sequence[str]) -> Iterator[Finding]:
    """All that is looked at of the way to the cloud.

    Args:
        connect: endpoints of routers.
        identity: identity folder, None: plain.
        pages: where parts serve their metrics, "http://host:port".
    """
    if identity is not None:
        yield of_identity(identity)
    yield shared_memory()
    for endpoint in connect:
        yield from router(endpoint, identity)
    for page in pages:
        yield from part(page)


def of_identity(folder: Path) -> Finding:
    """Whether an identity folder would be accepted now, and for how long."""
    from gnd.fleet_bus.identity.folder import load_identity, problems

    what = f"identity {folder}"
    try:
        identity = load_identity(folder)
    except IdentityError as error:
        return Finding(what, "fault", str(error), "issue it anew (`gnd certs`), or name another by --identity")
    if found := problems(identity):
        return Finding(what, "fault", "; ".join(found), f"gnd certs renew {folder}; set the clock if that is wrong")
    name = f"{identity.member.common_name}, holds {identity.left_s() / _DAY_S:.1f} days more"
    if identity.ends_soon():
        return Finding(what, "warning", name, f"gnd certs renew {folder}: less than a quarter of its time is left")
    return Finding(what, "ok", name)


def shared_memory() -> Finding:
    """Whether messages go through sockets alone, where they are counted; also that zenoh takes all our rules."""
    what = "zenoh"
    try:
        settings = zenoh_config(BusConfig(identity=None))
    except BusError as error:
        do = "install the version of eclipse-zenoh that constraints.txt names"
        return Finding(what, "fault", str(error), do)
    if json.loads(settings.get_json("transport/shared_memory/enabled")):
        return Finding(what, "fault", "shared memory is on", "install the eclipse-zenoh of constraints.txt")
    return Finding(what, "ok", f"{build_info()['zenoh']}: takes all our settings; shared memory is off")


def router(endpoint: str, identity: Path | None) -> Iterator[Finding]:
    """Whether a router answers, and who answers behind it."""
    what, began_s = f"router {endpoint}", time.monotonic()
    try:
        config = BusConfig(connect=(endpoint,), identity=identity, open_timeout_s=_OPEN_S)
        with open_bus(config, name="doctor") as bus:
            yield Finding(what, "ok", f"lets us in after {time.monotonic() - began_s:.2f} s")
            yield _tiles(endpoint, bus)
    except BusError as error:
        yield Finding(what, "fault", str(error), _what_to_do(str(error)))


def _what_to_do(why: str) -> str:
    for sign, do in (
        ("nothing listens", "start it (gnd router), or check host, port and firewall"),
        ("not from our authority", "copy authority.pem of the fleet's authority into the identity folder"),
        ("does not come from", "use identities of one authority on both sides (`gnd certs check`)"),
        ("expired", "gnd certs renew; compare both clocks"),
        ("clock", "set the clock, best by NTP"),
        ("not for the name", "connect by a name in the router's certificate, or issue it with --host"),
        ("revoked", "ask the operator: this member was shut out (`gnd certs list`)"),
        ("identity folder", "name one: --identity FOLDER or GND_IDENTITY (`gnd certs`)"),
        ("no TLS", "use tcp/ there, or a router with an identity"),
    ):
        if sign in why:
            return do
    return "start a router there, or check host, port and firewall"


def _tiles(endpoint: str, bus: Bus) -> Finding:
    what, began_s = f"tile server behind {endpoint}", time.monotonic()
    try:
        bus.request(catalog_key(DEFAULT_LAYER, _SOMEWHERE.district), b"", kind="catalog", timeout_s=_ANSWER_S)
    except BusError as error:
        return Finding(what, "warning", str(error), "start one (gnd store), or look at the log of the one that runs")
    return Finding(what, "ok", f"answers after {time.monotonic() - began_s:.2f} s")


def part(page: str) -> Iterator[Finding]:
    """What a part says of itself on its pages: health, versions, clock."""
    base, what = page.rstrip("/").removesuffix("/metrics"), f"part {page}"
    try:
        yield _health(what, _get(f"{base}/healthz"))
        asked_s = time.time()
        text = _get(f"{base}/metrics")[1]
        values = _metrics(text)
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = str(error.reason) if isinstance(error, urllib.error.URLError) else str(error)
        do = "start that part with --metrics-port, or check host, port and firewall"
        yield Finding(what, "fault", f"no pages there: {reason}", do)
        return
    yield _versions(what, values.get(BUILD))
    yield _clock(what, values.get(CLOCK), asked_s, time.time())


def _get(url: str) -> tuple[int, str]:
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"{url} is not like http://127.0.0.1:9100")
    try:
        with urllib.request.urlopen(url, timeout=_ANSWER_S) as answer:  # noqa: S310 - the scheme was looked at
            return answer.status, answer.read(_MOST_BYTES).decode("utf-8")
    except urllib.error.HTTPError as error:  # 503: a part that is ill says so
        return error.code, error.read(_MOST_BYTES).decode("utf-8")


def _metrics(text: str) -> dict[str, tuple[dict[str, str], float]]:
    """The first sample of each metric of ours: labels and value."""
    found: dict[str, tuple[dict[str, str], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, (dict(sample.labels), float(sample.value)))
    return found


def _health(what: str, answer: tuple[int, str]) -> Finding:
    status, text = answer
    told = json.loads(text)
    checks = told.get("checks", {}) if isinstance(told, dict) else {}
    ill = [f"{name}: {why}" for name, why in checks.items() if why != "ok"]
    if status == http.HTTPStatus.OK and not ill:
        return Finding(what, "ok", f"well ({', '.join(checks)})")
    return Finding(what, "fault", "; ".join(map(str, ill)) or f"status {status}", "see its log and docs/operations.md")


def _versions(what: str, told: tuple[dict[str, Any], float] | None) -> Finding:
    if told is None:
        return Finding(what, "warning", "does not tell its version: it is older than this one", "upgrade it")
    own = build_info()
    other = {name: (theirs, own[name]) for name, theirs in told[0].items() if name in own and theirs != own[name]}
    if not other:
        return Finding(what, "ok", f"same programs as here: {own['version']}, zenoh {own['zenoh']}")
    says = ", ".join(f"{name} {theirs} there, {ours} here" for name, (theirs, ours) in other.items())
    if "version" in other or "zenoh" in other:
        return Finding(what, "warning", says, "install one release everywhere, the cloud before vehicles")
    return Finding(what, "ok", f"same release; {says}")


def _clock(what: str, told: tuple[dict[str, Any], float] | None, asked_s: float, answered_s: float) -> Finding:
    if told is None:
        return Finding(what, "warning", "does not tell its clock: it is older than this one", "upgrade it")
    theirs_s = told[1]
    off_s = theirs_s - min(max(theirs_s, asked_s), answered_s)  # 0 where it lies between question and answer
    says = f"its clock is off by {off_s:+.2f} s (the answer took {1000 * (answered_s - asked_s):.0f} ms)"
    if abs(off_s) <= _OFF_S[0]:
        return Finding(what, "ok", says)
    state: State = "warning" if abs(off_s) <= _OFF_S[1] else "fault"
    return Finding(what, state, says, "set both clocks by NTP: certificates and times of reports depend on them")
