"""Attacks on what is said: forged, altered, repeated and misplaced messages, on a router that lets everybody in."""

import datetime as dt
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh
from signing_scene import HOUR, NOW, Authority
from suite_ports import new_port

from gnd.fleet_bus import seals
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import IdentityError, Refused, RequestFailed, RequestRefused, SealError
from gnd.fleet_bus.requesting import END_OF_ANSWERS, REFUSED, RetryPolicy
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seal_keys import load_signer
from gnd.fleet_bus.serving import Request

TILES = "gnd/v1/tiles/ndt/13033/03021/12301"
OTHER_TILES = "gnd/v1/tiles/ndt/13033/03021/12302"
CATALOG = "gnd/v1/catalog/ndt/13033/03021/12301"
CHANGE = "gnd/v1/change/ndt/13033/03021/12301"
UPDATE = "gnd/v1/update/ndt/13033/03021/12301/00000"
WANT = "gnd/v1/want/v1"
STATE = "gnd/v1/state/v1"
SOON = RetryPolicy(attempt_timeout_s=1.0)


@dataclass
class Heard:
    """What a handler was asked."""

    requests: "queue.SimpleQueue[Request]" = field(default_factory=queue.SimpleQueue)

    def __call__(self, request: Request) -> bytes:
        self.requests.put(request)
        return b"true"

    def none(self) -> bool:
        return self.requests.empty()


@dataclass
class Scene:
    """A router, an authority, the cloud's parts, a vehicle, and a stranger with plain zenoh."""

    endpoint: str
    authority: Authority
    tiles: Bus
    shard: Bus
    vehicle: Bus
    stranger: zenoh.Session
    change: Heard = field(default_factory=Heard)

    def join(self, folder: Path | None, name: str = "") -> Bus:
        return open_bus(BusConfig(connect=(self.endpoint,), identity=folder), name=name)

    def ask(self, key: str = TILES, payload: bytes = b"which", timeout_s: float = 5.0) -> bytes:
        return self.vehicle.request(key, payload, kind="tile", retry=SOON, timeout_s=timeout_s)

    def report(self, payload: bytes = b"report", bus: Bus | None = None, timeout_s: float = 5.0) -> bytes:
        return (bus or self.vehicle).request(CHANGE, payload, kind="change", retry=SOON, timeout_s=timeout_s)


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def opened(authority: Authority) -> Iterator[Scene]:
    endpoint = f"tcp/127.0.0.1:{new_port()}"
    with open_router([endpoint]):
        parts = {
            "tiles": authority.part("tiles", "t1"),
            "shard": authority.part("shard", "s1"),
            "vehicle": authority.part("vehicle", "v1"),
        }
        buses = {
            role: open_bus(BusConfig(connect=(endpoint,), identity=folder), name=role) for role, folder in parts.items()
        }
        stranger = zenoh.open(zenoh_config(BusConfig(connect=(endpoint,))))
        scene = Scene(endpoint, authority, stranger=stranger, **buses)
        buses["tiles"].serve("gnd/v1/tiles/**", lambda _: b"true", complete=True, kind="tile")
        buses["tiles"].serve("gnd/v1/catalog/**", catalogs, complete=True, kind="catalog")
        buses["shard"].serve("gnd/v1/change/**", scene.change, complete=True, kind="change")
        buses["shard"].serve("gnd/v1/state/*", lambda _: b"true", complete=True, kind="change")
        yield scene
        stranger.close()
        for bus in buses.values():
            bus.close()


def catalogs(request: Request) -> bytes | list[tuple[str, bytes]]:
    if request.payload == b"nonsense":
        raise Refused("no such question")
    return [(CATALOG, b"true")] if request.is_wild else b"true"


@pytest.fixture
def scene(opened: Scene) -> Scene:
    while not opened.change.none():
        opened.change.requests.get()
    return opened


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.01)


def impostor(scene: Scene, keyexpr: str, answer: Callable[[zenoh.Query], None]) -> "zenoh.Queryable[None]":
    """A stranger that answers, too, and says that it knows all."""

    def handle(query: zenoh.Query) -> None:
        with query:
            answer(query)

    return scene.stranger.declare_queryable(keyexpr, handle, complete=True)


# ---- what works


def test_sealed_parts_speak_with_each_other(scene: Scene) -> None:
    assert scene.ask() == b"true"
    assert scene.report() == b"true"
    asker = scene.change.requests.get(timeout=5).asker
    assert asker is not None
    assert (asker.role, asker.name, asker.owner) == ("vehicle", "v1", "owner")
    assert scene.vehicle.request(STATE, b"?", kind="change") == b"true"
    assert scene.vehicle.request_many("gnd/v1/catalog/ndt/**", b"", kind="catalog") == [(CATALOG, b"true")]


def test_notices_of_the_right_part_arrive(scene: Scene) -> None:
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with scene.vehicle.subscribe(UPDATE, lambda _, payload: heard.put(payload), history=True):
        publisher = scene.shard.advanced_publisher(UPDATE)
        time.sleep(0.3)
        publisher.put(b"new version")
        assert heard.get(timeout=10) == b"new version"
    late: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with scene.vehicle.subscribe(UPDATE, lambda _, payload: late.put(payload), history=True):
        assert late.get(timeout=10) == b"new version"  # what a publisher remembers keeps its seal


def test_a_part_without_identity_reads_what_is_sealed(scene: Scene) -> None:
    with scene.join(None) as plain:
        assert plain.request(TILES, b"which", kind="tile") == b"true"
        assert plain.request_many("gnd/v1/catalog/ndt/**", b"", kind="catalog") == [(CATALOG, b"true")]
        with pytest.raises(RequestRefused, match="no such question"):
            plain.request(CATALOG, b"nonsense", kind="catalog")


def test_a_refusal_of_the_right_part_is_final(scene: Scene) -> None:
    with pytest.raises(RequestRefused, match="no such question"):
        scene.vehicle.request(CATALOG, b"nonsense", kind="catalog", timeout_s=5.0)


# ---- answers


def test_attack_fake_tile_server_poisons_fetches(scene: Scene) -> None:
    """A stranger answers 40 questions about tiles beside the tile server; what lacks its seal is dropped."""
    fake = impostor(scene, "gnd/v1/tiles/**", lambda query: query.reply(query.key_expr, b"poison"))
    try:
        assert [scene.ask() for _ in range(40)] == [b"true"] * 40
    finally:
        fake.undeclare()


def test_attack_fake_tile_server_alone(scene: Scene) -> None:
    """The true tile server is away and a stranger answers; the question stays without an answer, and says why."""
    fake = impostor(scene, "gnd/v1/tile/**", lambda query: query.reply(query.key_expr, b"poison"))
    try:
        with pytest.raises(RequestFailed, match="no seal"):
            scene.vehicle.request(
                "gnd/v1/tile/ndt/13033/03021/12301/00000", b"", kind="tile", timeout_s=2.0, retry=SOON
            )
    finally:
        fake.undeclare()


def test_attack_fake_ack_throws_reports_away(scene: Scene) -> None:
    """A stranger acknowledges reports that no shard has; a vehicle keeps each until a shard's seal has come."""
    fake = impostor(scene, "gnd/v1/change/**", lambda query: query.reply(query.key_expr, b"fake ack"))
    try:
        assert [scene.report(f"report {n}".encode()) for n in range(10)] == [b"true"] * 10
    finally:
        fake.undeclare()


def test_attack_fake_refusal_ends_a_request(scene: Scene) -> None:
    """A stranger says "refused, do not ask again"; without the seal of who may refuse it is asked again."""
    fake = impostor(scene, "gnd/v1/change/**", lambda query: query.reply_err(b"go away", encoding=REFUSED))
    try:
        assert scene.report() == b"true"
    finally:
        fake.undeclare()


def test_attack_fake_state_releases_a_report(scene: Scene) -> None:
    """A stranger answers "released" when a vehicle asks how far its report is; only a shard's seal counts."""
    fake = impostor(scene, "gnd/v1/state/*", lambda query: query.reply(query.key_expr, b"released"))
    try:
        answers = [scene.vehicle.request(STATE, b"?", kind="change", retry=SOON) for _ in range(5)]
        assert answers == [b"true"] * 5
    finally:
        fake.undeclare()


def test_attack_answer_of_yesterday(scene: Scene) -> None:
    """A router keeps a sealed answer and gives it again later; it is bound to its question's number."""
    kept: list[tuple[bytes, bytes]] = []
    with scene.join(None) as listener:
        session = listener.connection.session
        replies = session.get(TILES, payload=b"which", attachment=a_question(scene, TILES, b"which"))
        for reply in replies:
            assert reply.ok is not None
            assert reply.ok.attachment is not None
            kept.append((reply.ok.payload.to_bytes(), reply.ok.attachment.to_bytes()))
    payload, seal = kept[0]
    fake = impostor(scene, TILES, lambda query: query.reply(query.key_expr, payload, attachment=seal))
    answer = seals.Seal.decode(seal)
    try:
        with pytest.raises(SealError, match="does not fit"):
            checked(scene, TILES, payload, answer)
        assert scene.ask() == b"true"
    finally:
        fake.undeclare()


def a_question(scene: Scene, key: str, payload: bytes) -> bytes:
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    return sealing.question(key, payload, count_wanted=False, with_chain=False).attachment


def checked(scene: Scene, key: str, payload: bytes, seal: seals.Seal) -> None:
    """As the vehicle checks an answer to a question that it asks now."""
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    asked = sealing.question(key, b"which", count_wanted=False, with_chain=False)
    sealing.check_answer(key, key, payload, seal.encode(), asked.digest)


def test_attack_answer_of_another_district(scene: Scene) -> None:
    """An answer of the true tile server about one district is given for another; the key is part of what is sealed."""
    sealing = scene.tiles.connection.sealing
    assert sealing is not None

    def swap(query: zenoh.Query) -> None:
        asked = seals.nonce_of(query.attachment.to_bytes() if query.attachment else b"")
        digest = seals.question_digest(OTHER_TILES, b"which", asked)
        query.reply(TILES, b"other", attachment=sealing.answer(OTHER_TILES, b"other", digest))

    fake = impostor(scene, TILES, swap)
    try:
        assert [scene.ask() for _ in range(5)] == [b"true"] * 5
    finally:
        fake.undeclare()


def test_attack_altered_answer(scene: Scene) -> None:
    """A router alters one byte of a sealed answer; the seal does not fit any more, and the question is asked again."""
    sealing = scene.tiles.connection.sealing
    assert sealing is not None

    def alter(query: zenoh.Query) -> None:
        asked = query.attachment.to_bytes() if query.attachment else b""
        digest = seals.question_digest(TILES, b"which", seals.nonce_of(asked))
        query.reply(TILES, b"tree", attachment=sealing.answer(TILES, b"true", digest))

    fake = impostor(scene, TILES, alter)
    try:
        assert [scene.ask() for _ in range(5)] == [b"true"] * 5
    finally:
        fake.undeclare()


def test_attack_stripped_seal(scene: Scene) -> None:
    """A router takes the seals off true answers, so that the vehicle believes anything; it believes nothing then."""
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    with pytest.raises(SealError, match="no seal"):
        sealing.check_answer(TILES, TILES, b"true", b"", b"")


@pytest.mark.parametrize("role", ["vehicle", "shard", "operator"])
def test_attack_part_of_another_role_answers_for_tiles(scene: Scene, role: str) -> None:
    """A part with a good certificate in another role answers as a tile server; the role in the certificate decides."""
    with (
        scene.join(scene.authority.part(role, "x", folder=f"{role}-answers")) as other,
        other.serve("gnd/v1/tile/**", lambda _: b"poison", complete=True, kind="tile"),
        pytest.raises(RequestFailed, match=f"{role} x has sealed|not known|nobody serves"),
    ):
        scene.vehicle.request("gnd/v1/tile/ndt/13033/03021/12301/00000", b"", kind="tile", timeout_s=2.0, retry=SOON)


def test_attack_foreign_authority_answers(scene: Scene, tmp_path: Path) -> None:
    """A tile server of an authority of its own answers; its certificate leads to nobody whom the vehicle trusts."""
    folder = Authority(tmp_path, "foreign").part("tiles", "t1")
    with (
        scene.join(folder) as foreign,
        foreign.serve("gnd/v1/tile/**", lambda _: b"poison", complete=True, kind="tile"),
        pytest.raises(RequestFailed, match=r"not of our authority|not known"),
    ):
        scene.vehicle.request("gnd/v1/tile/ndt/13033/03021/12301/00000", b"", kind="tile", timeout_s=3.0, retry=SOON)


def test_attack_authority_of_the_same_name(scene: Scene, tmp_path: Path) -> None:
    """The foreign authority calls itself as ours does; the signature is checked, not the name."""
    folder = Authority(tmp_path, scene.authority.name).part("tiles", "t9")
    foreign = load_signer(folder)
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    with pytest.raises(SealError, match="not of our authority"):
        sealing._certificates.learn(foreign.chain)


def test_attack_vehicle_signs_certificates(scene: Scene, tmp_path: Path) -> None:
    """A vehicle uses its key as an authority and makes a tile server; a part's certificate may not sign others."""
    vehicle = Authority(tmp_path, "vehicle")
    own = load_signer(scene.authority.part("vehicle", "signs"))
    maker = Authority(tmp_path / "made", "x", key=own._key)
    made = load_signer(maker.part("tiles", "t1"))
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    assert vehicle.certificate is not None
    with pytest.raises(SealError, match=r"another place in the chain|not of our authority"):
        sealing._certificates.learn(made.chain + own.chain)


def test_attack_invented_certificates(scene: Scene) -> None:
    """A stranger seals with thousands of invented certificates; after a few, none is asked for any more."""
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    for number in range(2000):
        seal = seals.Seal("notice", number.to_bytes(8, "big"), 0, bytes(64))
        sealing._in_vain.setdefault(number.to_bytes(8, "big"), time.monotonic() + 0.2) if number < 16 else None
        with pytest.raises(SealError, match=r"not known|nobody shows"):
            sealing.check_notice(UPDATE, b"x", seal.encode())
    assert len(sealing._in_vain) <= 17
    time.sleep(0.3)


# ---- notices


@pytest.mark.parametrize("key", [UPDATE, WANT])
def test_attack_forged_notice(scene: Scene, key: str) -> None:
    """A stranger puts a notice (version 4,000,000,000; "released"); it is dropped, and the true next one is heard."""
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with scene.vehicle.subscribe(key, lambda _, payload: heard.put(payload)):
        time.sleep(0.3)
        before = scene.vehicle.connection.sealing.refused.total()  # type: ignore[union-attr]
        scene.stranger.put(key, b"version 4000000000")
        until(lambda: scene.vehicle.connection.sealing.refused.total() > before, "the forged notice is counted")  # type: ignore[union-attr]
        scene.shard.publish(key, b"true", kind="update")
        assert heard.get(timeout=10) == b"true"
        assert heard.empty()


def test_attack_vehicle_puts_an_update(scene: Scene) -> None:
    """A vehicle with a good certificate announces a version; only shards may."""
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with (
        scene.join(scene.authority.part("vehicle", "announcer")) as bad,
        scene.vehicle.subscribe(UPDATE, lambda _, payload: heard.put(payload)),
    ):
        time.sleep(0.3)
        bad.publish(UPDATE, b"poison", kind="update")
        scene.shard.publish(UPDATE, b"true", kind="update")
        assert heard.get(timeout=20) == b"true"


def test_attack_notice_moved_to_another_tile(scene: Scene) -> None:
    """A true notice about one tile is put on the key of another; the key is part of what is sealed."""
    sealing = scene.shard.connection.sealing
    assert sealing is not None
    seal = sealing.notice(UPDATE.replace("00000", "00001"), b"moved")
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with scene.vehicle.subscribe(UPDATE, lambda _, payload: heard.put(payload)):
        time.sleep(0.3)
        scene.stranger.put(UPDATE, b"moved", attachment=seal)
        scene.shard.publish(UPDATE, b"true", kind="update")
        assert heard.get(timeout=10) == b"true"


def test_attack_answer_used_as_notice(scene: Scene) -> None:
    """The seal of an answer is put beside a notice; what kind of message it is, is sealed, too."""
    sealing = scene.shard.connection.sealing
    assert sealing is not None
    vehicle = scene.vehicle.connection.sealing
    assert vehicle is not None
    with pytest.raises(SealError, match=r"seal of a answer on a notice|seal of an answer"):
        vehicle.check_notice(UPDATE, b"x", sealing.answer(UPDATE, b"x", b""))


# ---- reports


def test_attack_report_without_a_seal(scene: Scene) -> None:
    """An anonymous client sends a report; a shard with an identity refuses what no vehicle has sealed."""
    with scene.join(None) as anonymous, pytest.raises(RequestRefused, match="no seal"):
        scene.report(b"anonymous", anonymous)
    assert scene.change.none()


def test_attack_report_repeated_by_a_listener(scene: Scene) -> None:
    """A listener keeps a sealed report and sends it again; its number was used, so it is not even looked at."""
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    scene.report(b"first")  # the shard knows the certificate from now on
    while not scene.change.none():
        scene.change.requests.get()
    attachment = sealing.question(CHANGE, b"kept", count_wanted=False, with_chain=False).attachment
    for expected in (1, 0, 0):
        list(scene.stranger.get(CHANGE, payload=b"kept", attachment=attachment))
        heard = 0
        while not scene.change.none():
            scene.change.requests.get()
            heard += 1
        assert heard == expected


def test_attack_report_kept_for_long(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener keeps a sealed report for a day and sends it to a restarted shard; it is too old."""
    sealing = scene.vehicle.connection.sealing
    shard = scene.shard.connection.sealing
    assert sealing is not None
    assert shard is not None
    for moved_s in (-86_400, 86_400):
        now_ns = time.time_ns()
        monkeypatch.setattr(seals.time, "time_ns", lambda moved_s=moved_s, now_ns=now_ns: now_ns + moved_s * 10**9)
        kept = sealing.question(CHANGE, b"kept", count_wanted=False, with_chain=True).attachment
        monkeypatch.undo()
        with pytest.raises(SealError, match="check the vehicle's clock"):
            shard.check_question(CHANGE, b"kept", kept)


@pytest.mark.parametrize("what", ["body", "key", "name"])
def test_attack_altered_report(scene: Scene, what: str) -> None:
    """A router alters a report, its district, or lays another vehicle's seal beside it; the seal does not fit."""
    sealing = scene.vehicle.connection.sealing
    shard = scene.shard.connection.sealing
    assert sealing is not None
    assert shard is not None
    attachment = sealing.question(CHANGE, b"report", count_wanted=False, with_chain=True).attachment
    key, body = CHANGE, b"report"
    if what == "body":
        body = b"repost"
    elif what == "key":
        key = CHANGE.replace("12301", "12302")
    else:
        seal = seals.Seal.decode(attachment)
        other = load_signer(scene.authority.part("vehicle", "other"))
        attachment = seals.Seal(
            "question", other.certificate_id, seal.time_ms, seal.signature, seal.nonce, chain=other.chain
        ).encode()
    with pytest.raises(SealError, match="does not fit"):
        shard.check_question(key, body, attachment)


def test_attack_shard_reports_as_a_vehicle(scene: Scene) -> None:
    """A shard's certificate is used to send reports; only vehicles report."""
    with pytest.raises(RequestRefused, match="shard s1 has sealed"):
        scene.report(b"from the cloud", scene.shard)


def test_attack_state_of_another_vehicle(scene: Scene) -> None:
    """A vehicle asks on the state key of another; its certificate names another vehicle."""
    with (
        scene.join(scene.authority.part("vehicle", "v2")) as other,
        pytest.raises(RequestRefused, match="speaks on the key of v1"),
    ):
        other.request(STATE, b"?", kind="change", retry=SOON, timeout_s=5.0)


@pytest.mark.parametrize(
    ("begins", "ends", "why"),
    [
        (NOW - 3 * HOUR, NOW - HOUR, "has ended"),
        (NOW + HOUR, NOW + 2 * HOUR, "not valid yet"),
    ],
)
def test_attack_certificate_out_of_time(scene: Scene, begins: dt.datetime, ends: dt.datetime, why: str) -> None:
    """A report is sealed with a certificate that has ended, or has not begun; it is refused with the reason."""
    signer = load_signer(scene.authority.part("vehicle", "v3", begins=begins, ends=ends, folder=why.replace(" ", "-")))
    shard = scene.shard.connection.sealing
    assert shard is not None
    attachment = signer.question(CHANGE, b"report", count_wanted=False, with_chain=True).encode()
    with pytest.raises(SealError, match=why):
        shard.check_question(CHANGE, b"report", attachment)


def test_attack_revoked_vehicle_reports(scene: Scene) -> None:
    """A vehicle was revoked while the fleet runs; within two seconds of the list's arrival its reports are refused."""
    folder = scene.authority.part("vehicle", "revoked")
    shard = scene.authority.folder / "shard.s1"
    with scene.join(folder) as bad:
        assert scene.report(b"still good", bad) == b"true"
        scene.authority.revoke(folder, shard)
        time.sleep(1.2)
        with pytest.raises(RequestRefused, match="was revoked"):
            scene.report(b"too late", bad)
    assert scene.report() == b"true"


def test_attack_list_that_frees_the_revoked(scene: Scene, tmp_path: Path) -> None:
    """Somebody lays an empty or a foreign list of revoked certificates; an older or unsigned list changes nothing."""
    folder = scene.authority.part("vehicle", "free-again")
    scene.authority.revoke(folder, scene.authority.folder / "shard.s1")
    time.sleep(1.2)
    scene.report()  # it looks at the list
    foreign = Authority(tmp_path, scene.authority.name)
    foreign.lists = 99
    foreign.revoke(foreign.part("vehicle", "nobody"), scene.authority.folder / "shard.s1")
    time.sleep(1.2)
    with scene.join(folder) as bad, pytest.raises(RequestRefused, match="was revoked"):
        scene.report(b"too late", bad)


def test_attack_key_of_another_certificate(scene: Scene, tmp_path: Path) -> None:
    """A stolen certificate is used with another key; the folder is refused, and so would its seals be."""
    good, stolen = scene.authority.part("vehicle", "victim"), tmp_path / "stolen"
    stolen.mkdir()
    for name in ("certificate.pem", "authority.pem"):
        (stolen / name).write_bytes((good / name).read_bytes())
    (stolen / "key.pem").write_bytes((scene.authority.part("vehicle", "thief") / "key.pem").read_bytes())
    with pytest.raises(IdentityError, match=r"key of another certificate"):
        scene.join(stolen)


@pytest.mark.parametrize("size", [0, 1, 2, 10, 50, 81, 87])
def test_attack_truncated_seal(scene: Scene, size: int) -> None:
    """A seal arrives truncated at any length; it is refused by name and nothing else happens."""
    shard = scene.shard.connection.sealing
    assert shard is not None
    whole = load_signer(scene.authority.folder / "vehicle.v1").question(
        CHANGE, b"x", count_wanted=False, with_chain=False
    )
    with pytest.raises(SealError):
        shard.check_question(CHANGE, b"x", whole.encode()[:size])


def test_attack_chain_that_costs_time(scene: Scene) -> None:
    """A seal brings a chain of hundreds of certificates, or of nonsense; it is bounded before anything is checked."""
    shard = scene.shard.connection.sealing
    assert shard is not None
    signer = load_signer(scene.authority.folder / "vehicle.v1")
    for chain in (signer.chain * 40, b"\xff\xff" + bytes(40), bytes(9), signer.chain + signer.chain * 3):
        seal = signer.question(CHANGE, b"x", count_wanted=False, with_chain=False)
        long = seals.Seal("question", seal.certificate_id, seal.time_ms, seal.signature, seal.nonce, chain=chain)
        with pytest.raises(SealError):
            shard.check_question(CHANGE, b"x", long.encode())


def test_attack_end_of_answers_is_announced_too_early(scene: Scene) -> None:
    """A stranger closes a region's answers with "none"; what the true tile server has answered still counts."""
    fake = impostor(scene, "gnd/v1/catalog/**", lambda query: query.reply_err(b"0", encoding=END_OF_ANSWERS))
    try:
        answers = scene.vehicle.request_many("gnd/v1/catalog/ndt/**", b"", kind="catalog", timeout_s=5.0)
        assert answers == [(CATALOG, b"true")]
    finally:
        fake.undeclare()


def test_many_threads_seal_and_check(scene: Scene) -> None:
    done: list[bytes] = []
    threads = [threading.Thread(target=lambda: done.extend(scene.report() for _ in range(5))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert done == [b"true"] * 40
