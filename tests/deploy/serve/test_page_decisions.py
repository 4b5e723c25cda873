"""What the page decides is done in the store and written down; who may not decide, or is fooled, changes nothing."""

import http.client
import json
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from page_testing import EAST, HERE, LiveStreet, ServedPage, columns_of, live_street, served, street_tile

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.deploy.account import tile_histories
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.folder import AUTHORITY, CERTIFICATE, KEY, REVOKED
from gnd.fleet_bus.identity.names import MemberName
from gnd.gnd_map.tile import content_sha
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.values import Publication


@pytest.fixture
def street(tmp_path: Path) -> Iterator[LiveStreet]:
    """A wall has come in the east, and is gone here."""
    with live_street(tmp_path, router=False) as opened:
        opened.merge(street_tile(EAST, wall=True), "vehicle-07", quietly=True)
        opened.merge(street_tile(HERE, wall=False), "vehicle-08", quietly=True)
        yield opened


@pytest.fixture
def page(street: LiveStreet) -> Iterator[ServedPage]:
    with served(street.path, "--allow-changes") as opened:
        yield opened


def change_of(page: ServedPage, what: str) -> dict:
    (found,) = (one for one in page.value("/api/changes")["changes"] if one["change"] == what)
    return found


def state_of(street: LiveStreet) -> list[tuple[int, bytes]]:
    found = [street.store.get("ndt", tile) for tile in (HERE, EAST)]
    return [(one.version, one.sha) for one in found if one is not None]


def surveyed(tile, *, wall: bool) -> bytes:
    return content_sha(tile, street_tile(tile, wall=wall).gaussians)


def test_accepting_doubting_and_rolling_back_do_what_they_say(page: ServedPage, street: LiveStreet) -> None:
    about = page.value("/api/map")
    assert about["may_decide"] is True
    new, deleted = change_of(page, "new"), change_of(page, "deleted")
    assert new["parts"] == [{"tile": EAST.morton, "before": 1, "version": 2}]

    assert page.decide(new["key"], "accept").status == 200
    assert change_of(page, "new")["accepted"]["who"] == about["viewer"]
    assert [version for version, _ in state_of(street)] == [2, 2]

    assert page.decide(deleted["key"], "roll_back", "  it  stood\nbehind a lorry ").status == 200
    assert state_of(street)[0] == (3, surveyed(HERE, wall=True))
    assert page.decide(deleted["key"], "roll_back", "twice").status == 409
    told = page.value("/api/changes")
    assert [one["change"] for one in told["changes"]] == ["new"]
    assert [(one["judgement"], one["why"]) for one in told["decided"]] == [
        ("rolled back", "it stood behind a lorry"),
        ("accepted", ""),
    ]

    assert page.decide(new["key"], "doubt", "a mirror").status == 200
    assert state_of(street)[1] == (3, surveyed(EAST, wall=False))
    assert street.store.doubted_vehicles("ndt", EAST) == {"vehicle-07"}
    (last,) = street.store.look(lambda c: trials.steered(c, "ndt", EAST))[-1:]
    assert (last.action, last.who, last.version) == ("doubted", about["viewer"], 3)
    assert Verifier(street.store, ShardConfig(store_path=street.path)).version("ndt", EAST, 3).status == "given"
    columns = columns_of(page.get(f"/api/tiles/{EAST.morton}/3.bin", Authorization=f"Bearer {page.token}").body)
    assert not columns["kind"].any(), "what was given back is as surveyed"


def test_forged_requests_and_bad_words_change_nothing(page: ServedPage, street: LiveStreet) -> None:
    key, before = change_of(page, "new")["key"], state_of(street)
    port = page.port
    forged = [
        (403, {"Origin": ""}),
        (403, {"Origin": "null"}),
        (403, {"Origin": "http://evil.example"}),
        (403, {"Origin": f"http://127.0.0.1:{port + 1}"}),
        (403, {"Origin": f"https://127.0.0.1:{port}"}),
        (403, {"Sec_Fetch_Site": "cross-site"}),
        (403, {"Sec_Fetch_Site": "same-site"}),
        (415, {"Content_Type": "text/plain"}),
        (415, {"Content_Type": "application/x-www-form-urlencoded"}),
        (401, {"Authorization": ""}),
        (401, {"Authorization": "Bearer " + "0" * 64}),
        (421, {"Host": f"evil.example:{port}"}),
    ]
    for status, headers in forged:
        assert page.decide(key, "roll_back", "x", **headers).status == status, headers
    own = {
        "Origin": f"http://127.0.0.1:{port}",
        "Content-Type": "application/json",
        "Authorization": f"Bearer {page.token}",
    }
    for status, body in (
        (400, b""), (400, b"[]"), (400, b"{"), (400, b"[" * 4000), (400, b'{"judgement": "accept"}'),
        (400, b'{"judgement": 1, "why": ""}'), (400, b'{"judgement": "delete", "why": "x"}'),
        (400, b'{"judgement": "doubt", "why": " "}'), (400, b'{"judgement": "accept", "why": "%s"}' % (b"x" * 501)),
        (400, rb'{"judgement": "accept", "why": "\u001b[2J"}'), (400, b"x" * 5000),
    ):  # fmt: skip
        assert page.post(f"/api/changes/{key}", body, own).status == status, body[:80]
    assert page.decide("0" * 16, "accept").status == 409
    assert page.decide("..%2f..", "accept").status in (404, 409)
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS"):
        assert page.get(f"/api/changes/{key}", method=method, Authorization=f"Bearer {page.token}").status == 405
    assert page.post("/api/map", b"{}", own).status == 405
    assert state_of(street) == before
    assert page.value("/api/changes")["decided"] == []
    assert street.store.look(lambda c: trials.steered(c, "ndt", EAST)) == []


def test_a_page_that_only_shows_decides_nothing(street: LiveStreet) -> None:
    before = state_of(street)
    with served(street.path) as page:
        assert page.value("/api/map")["may_decide"] is False
        key = change_of(page, "new")["key"]
        for judgement in ("accept", "doubt", "roll_back"):
            assert page.decide(key, judgement, "x", Authorization="").status == 405
    assert state_of(street) == before


def test_a_shard_that_merges_meanwhile_is_not_disturbed(page: ServedPage, street: LiveStreet) -> None:
    """It publishes every version of its tiles; what it was merging of a tile that is rolled back it publishes not."""
    stop, merged = threading.Event(), list[int]()

    def shard() -> None:
        hump = 0
        while not stop.is_set():
            hump = hump % 40 + 1
            merged.append(street.merge(street_tile(HERE, wall=False, hump=0.01 * hump), "vehicle-09", quietly=True))

    new = change_of(page, "new")["key"]
    thread = threading.Thread(target=shard)
    thread.start()
    try:
        while len(merged) < 3:
            assert thread.is_alive()
        assert page.decide(new, "roll_back", "not there").status == 200
        answers = [page.decide(change_of(page, "deleted")["key"], "accept").status for _ in range(3)]
        n = len(merged)
        while len(merged) < n + 3:
            assert thread.is_alive()
    finally:
        stop.set()
        thread.join()
    assert set(answers) <= {200, 409}
    assert merged == list(range(3, 3 + len(merged))), "every version of the shard, one after another"
    assert state_of(street)[1] == (3, surveyed(EAST, wall=False))

    street.merge(street_tile(EAST, wall=True), quietly=True)
    report = street.put_report(street_tile(EAST, wall=True, hump=0.2))
    (claim,) = street.store.claim("shard-0", 10, 30.0)
    assert street.store.load(claim).base_version == 4
    assert page.decide(change_of(page, "new")["key"], "roll_back", "again").status == 200
    late = Publication(claim, 4, street_tile(EAST, wall=True, hump=0.2), report_ids=(report.report_id,))
    (result,) = street.store.publish([late])
    assert (result.status, state_of(street)[1]) == ("stale", (5, surveyed(EAST, wall=False)))
    assert street.merge(street_tile(EAST, wall=True, hump=0.1), "vehicle-11", quietly=True) == 6


def asked(port: int, context: ssl.SSLContext, method: str, path: str, body: str = "") -> tuple[int, dict]:
    connection = http.client.HTTPSConnection("localhost", port, context=context, timeout=60)
    try:
        headers = {"Origin": f"https://localhost:{port}", "Content-Type": "application/json"}
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read() or b"{}")
    finally:
        connection.close()


def test_with_certificates_operators_decide_members_look_and_nobody_else(tmp_path: Path, street: LiveStreet) -> None:
    authority = Authority.create(tmp_path / "authority", "fleet")
    folders = {}
    for role, name in (("router", "page"), ("operator", "ann"), ("operator", "bob"), ("vehicle", "v-1")):
        folders[name] = tmp_path / name
        authority.issue(MemberName(role, name), folders[name])
    stranger = Authority.create(tmp_path / "other", "others")
    stranger.issue(MemberName("operator", "eve"), tmp_path / "eve")
    server = folders["page"]
    arguments = ("--certificate", str(server / CERTIFICATE), "--key", str(server / KEY), "--roles", str(server),
                 "--name", "localhost", "--allow-changes")  # fmt: skip

    def context(name: str) -> ssl.SSLContext:
        found = ssl.create_default_context(cafile=str(server / AUTHORITY))
        if name:
            found.load_cert_chain(str(tmp_path / name / CERTIFICATE), str(tmp_path / name / KEY))
        return found

    with served(street.path, *arguments) as page:
        port = page.port
        assert page.token == ""
        told = {name: asked(port, context(name), "GET", "/api/map") for name in ("", "v-1", "ann")}
        assert [told[name][0] for name in told] == [401, 200, 200]
        assert [told[name][1]["may_decide"] for name in ("v-1", "ann")] == [False, True]
        with pytest.raises((ssl.SSLError, ConnectionError, http.client.RemoteDisconnected)):
            asked(port, context("eve"), "GET", "/api/map")
        changes = asked(port, context("ann"), "GET", "/api/changes")[1]["changes"]
        path = f"/api/changes/{changes[0]['key']}"
        word = json.dumps({"judgement": "accept", "why": "seen"})
        assert asked(port, context("v-1"), "POST", path, word)[0] == 403
        assert asked(port, context(""), "POST", path, word)[0] == 401
        assert asked(port, context("bob"), "POST", path, word)[0] == 200
        (decided,) = asked(port, context("ann"), "GET", "/api/changes")[1]["decided"]
        assert decided["who"] == "operator.bob"
        authority.revoke(MemberName("operator", "bob"))
        (server / REVOKED).write_bytes((tmp_path / "authority" / REVOKED).read_bytes())
        assert asked(port, context("bob"), "POST", path, word)[0] == 401
        assert asked(port, context("ann"), "POST", path, word)[0] == 200
    assert np.array_equal([version for version, _ in state_of(street)], [2, 2])


def test_what_is_told_of_a_run_counts_from_the_survey_also_when_a_change_was_taken_back(
    page: ServedPage, street: LiveStreet
) -> None:
    street.merge(street_tile(EAST, wall=True, hump=0.3), quietly=True)
    lifted = {one.tile.tile: one.changed_voxels() for one in tile_histories(street.store)}[EAST] - 120
    assert page.decide(change_of(page, "new")["key"], "roll_back", "not there").status == 200
    assert {one.tile.tile: one.changed_voxels() for one in tile_histories(street.store)}[EAST] == lifted > 0
