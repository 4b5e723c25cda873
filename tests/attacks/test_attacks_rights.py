"""Every role tries every verb on every key, against a real router: what is not its right neither leaves nor arrives."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from identity_scene import Scene, be_settled, scene, until

from gnd.fleet_bus.identity.names import MemberName

V1 = "gnd/v1"
DISTRICT = "13033/03021/21000"
TILE, TILES, CATALOG, CHANGE, UPDATE = (
    f"{V1}/tile/ndt/{DISTRICT}/00000",
    f"{V1}/tiles/ndt/{DISTRICT}",
    f"{V1}/catalog/ndt/{DISTRICT}",
    f"{V1}/change/ndt/{DISTRICT}",
    f"{V1}/update/ndt/{DISTRICT}/00000",
)
OF_A = {kind: f"{V1}/{kind}/a" for kind in ("want", "state", "traffic")} | {"live": f"{V1}/live/a/lidar-points"}
OF_B = {kind: f"{V1}/{kind}/b" for kind in ("want", "state", "traffic")} | {"live": f"{V1}/live/b/lidar-points"}
ALIVE_A, ALIVE_B, ALIVE_SHARD, ALIVE_OTHER, ALIVE_STORE, ALIVE_STORE_2 = (
    f"{V1}/alive/{one}"
    for one in ("agent/a", "agent/b", "merger/shard-0", "merger/shard-1", "store/store", "store/store-2")
)
REVOKED = f"{V1}/authority/revoked"
LISTS = {f"{V1}/authority/members", REVOKED}
MAP = {TILE, TILES, CATALOG}
TOKENS = {ALIVE_A, ALIVE_B, ALIVE_SHARD, ALIVE_OTHER, ALIVE_STORE, ALIVE_STORE_2}
KEYS = {*MAP, CHANGE, UPDATE, *OF_A.values(), *OF_B.values(), *TOKENS, *LISTS, f"{V1}/else", "gnd/v2/tile", "other/key"}
WILD = {
    "**",
    "gnd/**",
    f"{V1}/**",
    f"{V1}/*/b",
    f"{V1}/want/*",
    f"{V1}/want/$*b",
    f"{V1}/want/b$*",
    f"{V1}/state/**",
    f"{V1}/live/**",
    f"{V1}/live/*/lidar-points",
    f"{V1}/alive/**",
}
ROLES = {"vehicle": "vehicle.a", "shard": "shard.shard-0", "tiles": "tiles.store", "operator": "operator.ops"}

# What each role may do; everything else among KEYS and WILD is an attack.
PUTS = {
    "vehicle": {OF_A["traffic"], OF_A["live"]},
    "shard": {OF_A["want"], OF_B["want"], UPDATE},
    "tiles": set(),
    "operator": LISTS,
}
HEARS = {
    "vehicle": {UPDATE, OF_A["want"], OF_A["live"], REVOKED},
    "shard": LISTS,
    "tiles": LISTS,
    "operator": {UPDATE, OF_A["traffic"], OF_B["traffic"], REVOKED},
}
ASKS = {"vehicle": {*MAP, CHANGE, OF_A["state"], OF_A["live"]}, "shard": set(), "tiles": set(), "operator": MAP}
ANSWERS = {
    "vehicle": {OF_A["live"]},
    "shard": {CHANGE, OF_A["state"], OF_B["state"]},
    "tiles": MAP,
    "operator": set(),
}
ALIVE = {"vehicle": {ALIVE_A}, "shard": {ALIVE_SHARD}, "tiles": {ALIVE_STORE}, "operator": set()}
SEES = {"vehicle": set(), "shard": {ALIVE_SHARD, ALIVE_OTHER}, "tiles": set(), "operator": TOKENS}
SETTLE_S = 0.4
every_role = pytest.mark.parametrize("role", list(ROLES))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A router with rights and all members."""
    with scene(tmp_path_factory.mktemp("rights")) as opened:
        yield opened


@pytest.fixture(scope="module")
def witness(place: Scene) -> Iterator[zenoh.Session]:
    """A session that may do everything: it sees what gets through, and serves as every victim."""
    with place.session("router.witness") as session:
        yield session


def keys_heard(samples: list[str], expected: set[str]) -> set[str]:
    """What arrived, after a while in which more would have arrived."""
    until(lambda: expected <= set(samples), 5.0)
    time.sleep(SETTLE_S)
    return set(samples)


def noting(into: list[str]) -> Callable[[Any], None]:
    """A callback that notes keys."""
    return lambda sample: into.append(str(sample.key_expr))


@every_role
def test_attack_puts_on_keys_of_others(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member publishes on every key there is, of others and of other roles; the router passes on its own alone."""
    heard: list[str] = []
    with place.session(ROLES[role]) as attacker, witness.declare_subscriber("**", noting(heard)):
        time.sleep(SETTLE_S)
        for key in KEYS:
            attacker.put(key, b"forged")
        assert keys_heard(heard, PUTS[role]) == PUTS[role]


@every_role
def test_attack_deletes_keys(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member deletes every key, its own included: nobody has that right, and no deletion arrives."""
    heard: list[str] = []
    with place.session(ROLES[role]) as attacker, witness.declare_subscriber("**", noting(heard)):
        time.sleep(SETTLE_S)
        for key in KEYS:
            attacker.delete(key)
        assert keys_heard(heard, set()) == set()


@every_role
def test_attack_listens_to_others(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member subscribes to every key and to wildcards over all of them; it hears what is meant for it alone."""
    heard: list[str] = []
    with place.session(ROLES[role]) as attacker:
        held = [attacker.declare_subscriber(key, noting(heard)) for key in (*KEYS, *WILD)]
        time.sleep(SETTLE_S)
        for key in KEYS:
            witness.put(key, b"secret")
        assert keys_heard(heard, HEARS[role]) == HEARS[role]
        assert len(held) == len(KEYS | WILD)


@every_role
def test_attack_asks_what_it_may_not(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member queries every key and wildcards over all; no server even hears of those that it may not ask."""
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        if str(query.key_expr) in KEYS:
            query.reply(query.key_expr, b"answer")

    with place.session(ROLES[role]) as attacker, witness.declare_queryable("**", answer):
        time.sleep(SETTLE_S)
        waiting = {key: attacker.get(key, timeout=3.0) for key in (*KEYS, *WILD)}
        answered = {key for key, replies in waiting.items() if any(reply.ok is not None for reply in replies)}
        assert answered == ASKS[role]
        assert set(asked) == ASKS[role]


@every_role
def test_attack_answers_for_others(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member declares itself the server of every key (a fake tile server, a fake ack); only its own are asked."""
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        query.reply(query.key_expr, b"poison")

    with place.session(ROLES[role]) as attacker:
        held = [attacker.declare_queryable(key, answer, complete=True) for key in (*KEYS, *WILD)]
        time.sleep(SETTLE_S)
        waiting = {key: witness.get(key, timeout=3.0) for key in KEYS}
        poisoned = {key for key, replies in waiting.items() if any(reply.ok is not None for reply in replies)}
        assert poisoned == ANSWERS[role]
        assert set(asked) == ANSWERS[role]
        assert len(held) == len(KEYS | WILD)


@every_role
def test_attack_ghost_tokens(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member holds liveliness tokens of shards, stores and vehicles that are not; only its own is seen."""
    with place.session(ROLES[role]) as attacker:
        held = [attacker.liveliness().declare_token(key) for key in TOKENS | {f"{V1}/else", UPDATE}]
        time.sleep(SETTLE_S)
        replies = witness.liveliness().get("**", timeout=3.0)
        assert {str(reply.ok.key_expr) for reply in replies if reply.ok is not None} == ALIVE[role]
        assert len(held) == len(TOKENS) + 2


@every_role
def test_attack_watches_who_is_there(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member looks at the liveliness tokens of all others; it sees those that its role needs."""
    seen: list[str] = []
    tokens = [witness.liveliness().declare_token(key) for key in TOKENS]
    try:
        with place.session(ROLES[role]) as attacker:
            for key in (*TOKENS, *WILD):
                attacker.liveliness().declare_subscriber(key, noting(seen), history=True)
            for key in TOKENS | WILD:
                seen += [str(one.ok.key_expr) for one in attacker.liveliness().get(key, timeout=3.0) if one.ok]
            assert keys_heard(seen, SEES[role]) == SEES[role]
    finally:
        for token in tokens:
            token.undeclare()


@every_role
def test_attack_admin_space(role: str, place: Scene, witness: zenoh.Session) -> None:
    """A member asks the router's admin space for its state and writes its configuration: it is closed."""
    router = str(next(iter(witness.info.routers_zid())))
    with place.session(ROLES[role]) as attacker:
        for key in ("@/**", f"@/{router}/**", f"@/{router}/router", f"@/{router}/router/config/**"):
            replies = [reply for reply in attacker.get(key, timeout=2.0) if reply.ok is not None]
            own = f"@/{attacker.info.zid()}/"  # one's own session answers for itself
            assert [one for one in replies if not str(one.ok.key_expr).startswith(own)] == []
        attacker.put(f"@/{router}/router/config/access_control/enabled", "false")
    with place.session("vehicle.b") as other:
        assert [one for one in other.get(OF_A["state"], timeout=2.0) if one.ok is not None] == []


def test_attack_member_of_no_list(place: Scene) -> None:
    """A certificate of our authority whose name is on no list of members is cut off, and gets no answer."""
    folder = place.root / "stranger"
    before = (place.authority.folder / "members.json").read_bytes()
    place.authority.issue(MemberName("vehicle", "stranger"), folder)  # nobody tells the router
    assert (place.authority.folder / "members.json").read_bytes() != before
    with place.session("tiles.store") as store, place.session(folder) as stranger:
        store.declare_queryable(TILE, lambda query: query.reply(TILE, b"tile"))
        time.sleep(SETTLE_S)
        for _ in range(5):
            assert [one for one in stranger.get(TILE, timeout=1.0) if one.ok is not None] == []
            time.sleep(0.1)


def test_a_new_member_gets_in_without_a_restart(place: Scene) -> None:
    """A vehicle whose certificate is new has its rights within seconds, and who was connected stays connected."""
    with place.bus("shard.shard-0") as shard, place.bus("vehicle.b") as other:
        shard.serve(f"{V1}/state/*", lambda request: request.key.encode())
        be_settled()
        connections = shard.connections, other.connections
        folder = place.issue("vehicle.new")
        with place.bus(folder) as new:
            assert new.request(f"{V1}/state/new", b"", kind="control", timeout_s=20) == f"{V1}/state/new".encode()
        assert other.request(OF_B["state"], b"", kind="control", timeout_s=10) == OF_B["state"].encode()
        assert (shard.connections, other.connections) == connections


def test_router_prints_its_rights(place: Scene, tmp_path: Path) -> None:
    """`gnd router --acl` prints what zenoh is given: default deny, and no rule for somebody who is no member."""
    identity = str(place.folder("router.main"))
    command = [sys.executable, "-m", "gnd.deploy.cli", "router", "--acl", "--identity", identity]
    rights = json.loads(subprocess.run(command, capture_output=True, check=True, text=True, cwd=tmp_path).stdout)
    assert rights["default_permission"] == "deny"
    assert {"vehicle.a", "shard.shard-0", "tiles.store"} <= {one["id"] for one in rights["subjects"]}
