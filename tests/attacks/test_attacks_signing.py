"""Attacks on what is said: forged, altered, repeated and misplaced messages, on a router that lets everybody in."""

import datetime as dt
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import zenoh
from signing_scene import HOUR, NOW, Authority
from suite_ports import new_port

from gnd.fleet_bus import sealing as sealing_module
from gnd.fleet_bus import seals
from gnd.fleet_bus.agreed_keys import KEYS_A_MEMBER, REPLAY_WINDOW, AgreedKey, GrantedKeys, KeyHalf
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import IdentityError, Refused, RequestFailed, RequestRefused, SealError
from gnd.fleet_bus.remembered import FILE
from gnd.fleet_bus.requesting import END_OF_ANSWERS, REFUSED, SIGNATURE_WANTED, RetryPolicy
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seal_keys import load_signer
from gnd.fleet_bus.sealing import HeardQuestion, SealedQuestion, Sealing, SignatureWanted
from gnd.fleet_bus.serving import CLOCK_RETRY_S, Request
from gnd.fleet_bus.short_seals import LATE, ShortSeal, TerseSeal, is_terse

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


def test_a_notice_that_nobody_checks_has_no_seal(scene: Scene) -> None:
    """Telemetry is believed by the router's rights alone: 74 bytes a sample would prove nothing to anybody."""
    heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with scene.stranger.declare_subscriber("gnd/v1/*/v1/**", heard.put):
        time.sleep(0.3)
        scene.vehicle.publish("gnd/v1/traffic/v1", b"sample", kind="telemetry")
        scene.shard.publish(WANT, b"states", kind="ack")
        samples = {str(one.key_expr): one for one in (heard.get(timeout=5.0), heard.get(timeout=5.0))}
    assert samples["gnd/v1/traffic/v1"].attachment is None
    assert samples[WANT].attachment is not None


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
    return sealing.question(key, payload, count_wanted=False, with_chain=False, short=False).attachment


def checked(scene: Scene, key: str, payload: bytes, seal: seals.Seal) -> None:
    """As the vehicle checks an answer to a question that it asks now."""
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    asked = sealing.question(key, b"which", count_wanted=False, with_chain=False, short=False)
    sealing.check_answer(key, key, payload, seal.encode(), asked)


def test_attack_answer_of_another_district(scene: Scene) -> None:
    """An answer of the true tile server about one district is given for another; the key is part of what is sealed."""
    sealing = scene.tiles.connection.sealing
    assert sealing is not None

    def swap(query: zenoh.Query) -> None:
        asked = seals.number_of(query.attachment.to_bytes() if query.attachment else b"")
        heard = HeardQuestion(None, seals.question_digest(OTHER_TILES, b"which", asked))
        query.reply(TILES, b"other", attachment=sealing.answer(OTHER_TILES, b"other", heard))

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
        heard = HeardQuestion(None, seals.question_digest(TILES, b"which", seals.number_of(asked)))
        query.reply(TILES, b"tree", attachment=sealing.answer(TILES, b"true", heard))

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
        sealing.check_answer(TILES, TILES, b"true", b"", SealedQuestion(b"", b""))


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
    sealing._in_vain.clear()
    for number in range(16):
        sealing._in_vain[number.to_bytes(8, "big")] = time.monotonic() + 60.0
    try:
        for number in range(2000):
            seal = seals.Seal("notice", number.to_bytes(8, "big"), 0, bytes(64))
            with pytest.raises(SealError, match=r"not known|nobody shows"):
                sealing.check_notice(UPDATE, b"x", seal.encode())
        assert len(sealing._in_vain) == 16
    finally:
        sealing._in_vain.clear()


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
        vehicle.check_notice(UPDATE, b"x", sealing.answer(UPDATE, b"x", HeardQuestion(None, b"")))


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
    attachment = sealing.question(CHANGE, b"kept", count_wanted=False, with_chain=False, short=False).attachment
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
        kept = sealing.question(CHANGE, b"kept", count_wanted=False, with_chain=True, short=False).attachment
        monkeypatch.undo()
        with pytest.raises(SealError, match="check the vehicle's clock"):
            shard.check_question(CHANGE, b"kept", kept)


@pytest.mark.parametrize("what", ["seal", "certificate"])
def test_a_report_that_does_not_count_by_the_clock_of_a_shard_is_kept_by_its_vehicle(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """Refused for good, it would be given up, though the clock may be that of the shard; once clocks are right, it
    counts.
    """
    begins = NOW + HOUR if what == "certificate" else NOW - HOUR
    folder = scene.authority.part("vehicle", f"late-{what}", begins=begins, ends=NOW + 10 * HOUR)
    with scene.join(folder) as vehicle:
        if what == "seal":
            monkeypatch.setattr(sealing_module, "MOST_SKEW_S", -1.0)
        words = (
            "check the vehicle's clock, and that of shard s1" if what == "seal" else "not valid yet: check the clocks"
        )
        with pytest.raises(RequestFailed, match=words) as failed:
            scene.report(b"early", vehicle)
        assert not isinstance(failed.value, RequestRefused)
        assert (failed.value.attempts, failed.value.retry_after_s) == (1 if what == "seal" else 2, CLOCK_RETRY_S)
        monkeypatch.undo()
        if what == "seal":
            assert scene.report(b"early", vehicle) == b"true"


@pytest.mark.parametrize("what", ["body", "key", "name"])
def test_attack_altered_report(scene: Scene, what: str) -> None:
    """A router alters a report, its district, or lays another vehicle's seal beside it; the seal does not fit."""
    sealing = scene.vehicle.connection.sealing
    shard = scene.shard.connection.sealing
    assert sealing is not None
    assert shard is not None
    attachment = sealing.question(CHANGE, b"report", count_wanted=False, with_chain=True, short=False).attachment
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
        (NOW + 10 * HOUR, NOW + 11 * HOUR, "not valid yet"),
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


# ---- keys that two parts have agreed on


def agreed_of(sealing: Sealing, key: str) -> AgreedKey:
    """The key with which the vehicle asks on `key`."""
    found = sealing._held.to_use(key, seals.ANSWERED_BY[key.split("/")[2]])
    assert found is not None, f"no key for {key}"
    return found


@pytest.fixture(params=["terse", "whole"])
def sealings(
    scene: Scene, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> tuple[Sealing, Sealing, Sealing]:
    """Of the vehicle, the shard and the tile server; the vehicle has agreed on a key with both, and used it: of terse
    seals, or, as with a part of an older release, of whole ones.
    """
    if request.param == "whole":
        monkeypatch.setattr("gnd.fleet_bus.agreed_keys._KNOWS_TERSE", 0)
    vehicle, shard, tiles = (bus.connection.sealing for bus in (scene.vehicle, scene.shard, scene.tiles))
    assert vehicle is not None
    assert shard is not None
    assert tiles is not None
    vehicle._held.clear()
    for _ in range(2):
        scene.report()
        scene.ask()
    while not scene.change.none():
        scene.change.requests.get()
    return vehicle, shard, tiles


def seen(vehicle: Sealing, attachment: bytes, key: str = CHANGE) -> ShortSeal:
    """The seal of the vehicle's last question on `key`, in full."""
    agreed = agreed_of(vehicle, key)
    if is_terse(attachment):
        return TerseSeal.decode(attachment).whole("question", agreed.key_id, agreed._asked)
    return ShortSeal.decode(attachment)


def short_question(vehicle: Sealing, key: str = CHANGE, payload: bytes = b"report") -> SealedQuestion:
    asked = vehicle.question(key, payload, count_wanted=False, with_chain=False)
    assert asked.agreed is not None
    return asked


def test_parts_agree_on_a_key_and_use_it(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    vehicle, shard, tiles = sealings
    asked = short_question(vehicle)
    form = agreed_of(vehicle, CHANGE).is_terse
    assert len(asked.attachment) == (11 if form else 13)
    heard = shard.check_question(CHANGE, b"report", asked.attachment)
    assert heard.asker is not None
    assert heard.binds is form
    assert (heard.asker.role, heard.asker.name) == ("vehicle", "v1")
    answer = shard.answer(CHANGE, b"true", heard)
    assert len(answer) == (8 if form else 9)
    assert vehicle.check_answer(CHANGE, CHANGE, b"true", answer, asked) is False
    refusal = shard.answer(CHANGE, b"no", heard, refusal=True)
    assert vehicle.check_answer(CHANGE, CHANGE, b"no", refusal, asked) is True
    bare = short_question(vehicle, TILES, b"which")
    assert len(bare.attachment) == (7 if form else 9)
    assert tiles.check_question(TILES, b"which", bare.attachment).asker is None
    heard_of: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with scene.vehicle.subscribe(WANT, lambda _, payload: heard_of.put(payload)):
        time.sleep(0.3)
        assert len(shard.notice(WANT, b"x")) == (11 if form else 13)
        scene.shard.publish(WANT, b"released", kind="ack")
        assert heard_of.get(timeout=10) == b"released"
    with pytest.raises(RequestRefused, match="no such question"):
        scene.vehicle.request(CATALOG, b"nonsense", kind="catalog", timeout_s=5.0)
    with pytest.raises(RequestRefused, match="no such question"):  # in short, too
        scene.vehicle.request(CATALOG, b"nonsense", kind="catalog", timeout_s=5.0)


def test_a_part_that_has_forgotten_its_keys_is_asked_with_a_signature(
    scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]
) -> None:
    """A shard or a tile server was started again: no report is lost, and a new key is there after one question."""
    vehicle, shard, tiles = sealings
    for _ in range(3):
        shard._granted.clear()
        tiles._granted.clear()
        before = agreed_of(vehicle, CHANGE)
        assert scene.report() == b"true"
        assert scene.ask() == b"true"
        assert agreed_of(vehicle, CHANGE).key_id != before.key_id
        assert len(short_question(vehicle).attachment) <= 14
    asker = scene.change.requests.get(timeout=5).asker
    assert asker is not None
    assert asker.name == "v1"


def test_a_part_is_killed_and_another_one_answers(scene: Scene) -> None:
    """Two parts take turns on the same keys; each has a key of its own, and who is new is asked with a number or a
    signature."""
    key = "gnd/v1/tile/ndt/13033/03021/12399/00000"
    folders = [scene.authority.part("tiles", f"turn{n}") for n in range(2)]
    with scene.join(scene.authority.part("vehicle", "turns")) as vehicle:
        for folder in (folders[0], folders[1], folders[0]):
            heard = Heard()
            with scene.join(folder) as part, part.serve(key, heard, complete=True, kind="tile"):
                for n in range(3):
                    payload = f"{folder.name} {n}".encode()
                    assert vehicle.request(key, payload, kind="tile", retry=SOON) == b"true"
                    assert heard.requests.get(timeout=5).payload == payload


def test_attack_short_report_repeated(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A listener sends a report with a short seal again: its number was used, so it is not even looked at."""
    attachment = short_question(sealings[0], payload=b"kept").attachment
    for expected in (1, 0, 0):
        list(scene.stranger.get(CHANGE, payload=b"kept", attachment=attachment))
        heard = 0
        while not scene.change.none():
            scene.change.requests.get()
            heard += 1
        assert heard == expected


@pytest.mark.parametrize("late", [1, 60, 500, 5000])
def test_attack_counter_goes_back(sealings: tuple[Sealing, Sealing, Sealing], late: int) -> None:
    """A report is held back and given when many later ones have passed, twice: it counts once, or not at all."""
    vehicle, shard, _ = sealings
    kept = short_question(vehicle).attachment
    agreed = agreed_of(vehicle, CHANGE)
    for left in range(late - 1, 0, -100):  # no more at a time than a terse seal can tell
        agreed._asked += min(left, 100) - 1
        shard.check_question(CHANGE, b"report", short_question(vehicle).attachment)
    shard.check_question(CHANGE, b"report", short_question(vehicle).attachment)
    is_in_time = late < (LATE if agreed.is_terse else REPLAY_WINDOW)
    if is_in_time:
        shard.check_question(CHANGE, b"report", kept)
    why = "used before" if is_in_time or not agreed.is_terse else "does not fit"  # another number than was meant
    with pytest.raises(SignatureWanted, match=why):
        shard.check_question(CHANGE, b"report", kept)


@pytest.mark.parametrize("what", ["body", "key", "count", "key id", "proof", "mark"])
def test_attack_altered_short_report(sealings: tuple[Sealing, Sealing, Sealing], what: str) -> None:
    """A router alters anything of a report with a short seal; it does not fit, and a signature is asked for."""
    vehicle, shard, _ = sealings
    key, body, seal = CHANGE, b"report", seen(vehicle, short_question(vehicle).attachment)
    if what == "body":
        body = b"repost"
    elif what == "key":
        key = CHANGE.replace("12301", "12302")
    elif what == "count":
        seal = replace(seal, count=seal.count + 1)
    elif what == "key id":
        seal = replace(seal, key_id=bytes(3))
    elif what == "proof":
        seal = replace(seal, mac=bytes([seal.mac[0] ^ 1]) + seal.mac[1:])
    else:
        seal = replace(seal, what="notice")
    altered = b"\xb4" + seal.encode()[1:] if what == "mark" else agreed_of(vehicle, CHANGE).written(seal)
    with pytest.raises(SignatureWanted):
        shard.check_question(key, body, altered)


def test_attack_short_proof_is_cut(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """The proof of a report is cut to the 4 bytes that do for a question about the map, or to any other length."""
    vehicle, shard, tiles = sealings
    whole = short_question(vehicle).attachment
    for size in range(len(whole)):
        with pytest.raises(SealError):
            shard.check_question(CHANGE, b"report", whole[:size])
    bare = short_question(vehicle, TILES, b"which").attachment
    for size in range(1, len(bare)):
        with pytest.raises(SealError):
            tiles.check_question(TILES, b"which", bare[:size])


def test_attack_short_seal_of_the_map_on_a_report(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A key that was agreed on without a name (a question about the map) is used to report; it names nobody."""
    vehicle, _, tiles = sealings
    agreed = agreed_of(vehicle, TILES)
    seal = agreed.question(CHANGE, b"report", is_bare=False)
    with pytest.raises(SignatureWanted, match="not known here"):
        tiles.check_question(CHANGE, b"report", agreed.written(seal))


def test_attack_short_seal_taken_to_another_part(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """What was sealed for one shard is given to another: each has keys of its own."""
    attachment = short_question(sealings[0]).attachment
    with scene.join(scene.authority.part("shard", f"elsewhere-{len(attachment)}")) as other:
        sealing = other.connection.sealing
        assert sealing is not None
        with pytest.raises(SignatureWanted, match="not known here"):
            sealing.check_question(CHANGE, b"report", attachment)


def test_attack_short_seal_of_another_vehicle(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A vehicle with a key of its own seals under another's key id, and asks after the other's reports."""
    vehicle, shard, _ = sealings
    name = f"thief-of-keys-{len(short_question(vehicle).attachment)}"
    with scene.join(scene.authority.part("vehicle", name)) as thief:
        for _ in range(2):
            scene.report(b"own", thief)
        own = thief.connection.sealing
        assert own is not None
        stolen = seen(vehicle, short_question(vehicle).attachment)
        made = replace(agreed_of(own, CHANGE).question(CHANGE, b"report", is_bare=False), key_id=stolen.key_id)
        for form in (made.encode(), made.encode_terse()):
            with pytest.raises(SignatureWanted, match=r"does not fit|not known here"):
                shard.check_question(CHANGE, b"report", form)
        own._held.answered(STATE, agreed_of(own, CHANGE).other)  # type: ignore[arg-type]
        asked = short_question(own, STATE, b"?")
        with pytest.raises(SignatureWanted, match="speaks on the key of v1"):
            shard.check_question(STATE, b"?", asked.attachment)
        with pytest.raises(RequestRefused, match="speaks on the key of v1"):
            thief.request(STATE, b"?", kind="change", retry=SOON, timeout_s=5.0)


def test_attack_answer_under_the_key_for_another_question(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A true short answer is given to the next question, to one of another district, or on another key."""
    vehicle, _, tiles = sealings
    first = short_question(vehicle, TILES, b"which")
    answer = tiles.answer(TILES, b"true", tiles.check_question(TILES, b"which", first.attachment))
    again, other = short_question(vehicle, TILES, b"which"), short_question(vehicle, OTHER_TILES, b"which")
    for asked, sealed, key in ((TILES, again, TILES), (OTHER_TILES, other, OTHER_TILES), (TILES, first, OTHER_TILES)):
        with pytest.raises(SealError, match="does not fit"):
            vehicle.check_answer(asked, key, b"true", answer, sealed)
    assert vehicle.check_answer(TILES, TILES, b"true", answer, first) is False


def test_attack_answer_asked_for_in_advance(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A stranger foresees the vehicle's next question, number included, and asks it to keep the answer for later."""
    vehicle, _, tiles = sealings
    seal = seen(vehicle, short_question(vehicle, TILES, b"which").attachment, TILES)
    agreed = agreed_of(vehicle, TILES)
    for guess in (bytes(4), seal.mac):
        foreseen = replace(seal, count=seal.count + 1, mac=guess)
        replies = list(scene.stranger.get(TILES, payload=b"which", attachment=agreed.written(foreseen)))
        assert [str(reply.err.encoding) for reply in replies if reply.err is not None] == [SIGNATURE_WANTED]
        with pytest.raises(SignatureWanted, match="does not fit"):
            tiles.check_question(TILES, b"which", agreed.written(foreseen))


def test_attack_reflected_seal(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A vehicle's own question comes back to it as an answer, or as a notice; each direction has its own key."""
    vehicle, _, _ = sealings
    asked = short_question(vehicle)
    seal, agreed = seen(vehicle, asked.attachment), agreed_of(vehicle, CHANGE)
    with pytest.raises(SealError, match="does not fit"):
        vehicle.check_answer(CHANGE, CHANGE, b"report", agreed.written(ShortSeal("answer", seal.mac)), asked)
    with pytest.raises(SealError, match="does not fit"):
        vehicle.check_notice(WANT, b"report", agreed.written(replace(seal, what="notice")))
    with pytest.raises(SealError, match=r"short seal of a question|does not fit"):
        vehicle.check_notice(WANT, b"report", asked.attachment)


def test_attack_short_notice_repeated_or_on_another_key(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A notice to one vehicle is repeated, moved to another key, or used as one for everybody."""
    vehicle, shard, _ = sealings
    notice = shard.notice(WANT, b"released")
    vehicle.check_notice(WANT, b"released", notice)
    with pytest.raises(SealError, match="used before"):
        vehicle.check_notice(WANT, b"released", notice)
    with pytest.raises(SealError, match="does not fit"):
        vehicle.check_notice(WANT.replace("v1", "v2"), b"released", shard.notice(WANT, b"released"))
    with pytest.raises(SealError, match="short seal of a notice"):
        vehicle.check_notice(UPDATE, b"released", shard.notice(WANT, b"released"))


def test_attack_other_half_of_a_key_is_swapped(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """Somebody between the two puts in a half of his own, in the question or in the answer; neither is believed."""
    vehicle, shard, tiles = sealings
    for keys in (vehicle._held, shard._granted, tiles._granted):
        keys.clear()
    own = KeyHalf.make()
    report = vehicle.question(CHANGE, b"report", count_wanted=False, with_chain=True)
    swapped = replace(seals.Seal.decode(report.attachment), share=own.share)
    with pytest.raises(SealError, match="does not fit"):
        shard.check_question(CHANGE, b"report", swapped.encode())
    asked = vehicle.question(TILES, b"which", count_wanted=False, with_chain=False)
    swapped = replace(seals.Seal.decode(asked.attachment), share=own.share)
    answer = tiles.answer(TILES, b"true", tiles.check_question(TILES, b"which", swapped.encode()))
    with pytest.raises(SealError, match="does not fit"):
        vehicle.check_answer(TILES, TILES, b"true", answer, asked)
    answer = tiles.answer(TILES, b"true", tiles.check_question(TILES, b"which", asked.attachment))
    for share in (own.share, bytes(32), b""):
        with pytest.raises(SealError, match="does not fit"):
            vehicle.check_answer(TILES, TILES, b"true", replace(seals.Seal.decode(answer), share=share).encode(), asked)
    assert vehicle._held.to_use(TILES, "tiles") is None


def test_attack_half_of_a_key_that_is_none(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A half of a key from which everybody knows what follows (zero) is offered: answered, and no key comes of it."""
    _, _, tiles = sealings
    for half in (bytes(32), b"\x01" + bytes(31)):
        asked = seals.Seal("number", b"", 0, b"", bytes(8), share=half)
        replies = [reply.ok for reply in scene.stranger.get(TILES, payload=b"which", attachment=asked.encode())]
        assert replies[0] is not None
        assert replies[0].attachment is not None
        assert seals.Seal.decode(replies[0].attachment.to_bytes()).share == b""
    assert tiles.check_question(TILES, b"which", asked.encode()).share == half


def test_attack_part_agrees_on_a_key_in_another_role(scene: Scene) -> None:
    """A vehicle answers for the tile server and offers half of a key; the role in its certificate decides."""
    key = "gnd/v1/tile/ndt/13033/03021/12377/00000"
    with (
        scene.join(scene.authority.part("vehicle", "agrees")) as other,
        other.serve(key, lambda _: b"poison", complete=True, kind="tile"),
        pytest.raises(RequestFailed, match=r"vehicle agrees has sealed|not known|nobody serves"),
    ):
        scene.vehicle.request(key, b"which", kind="tile", timeout_s=2.0, retry=SOON)
    sealing = scene.vehicle.connection.sealing
    assert sealing is not None
    assert all(one.other is not None and one.other.role != "vehicle" for one in sealing._held._of_part.values())


def test_attack_key_of_a_revoked_vehicle(scene: Scene) -> None:
    """A vehicle has a key with the shard and is revoked: within two seconds its short seals do not count either."""
    folder = scene.authority.part("vehicle", "revoked-with-key")
    with scene.join(folder) as bad:
        for _ in range(2):
            assert scene.report(b"still good", bad) == b"true"
        sealing, shard = bad.connection.sealing, scene.shard.connection.sealing
        assert sealing is not None
        assert shard is not None
        asked = short_question(sealing, payload=b"too late")
        scene.authority.revoke(folder, scene.authority.folder / "shard.s1")
        time.sleep(1.2)
        with pytest.raises(SignatureWanted, match="was revoked"):
            shard.check_question(CHANGE, b"too late", asked.attachment)
        with pytest.raises(RequestRefused, match="was revoked"):
            scene.report(b"too late", bad)
        assert shard.notice("gnd/v1/want/revoked-with-key", b"x").startswith(seals.MARK)  # no key is used any more
    assert scene.report() == b"true"


def test_attack_key_of_a_revoked_part(scene: Scene) -> None:
    """A tile server is revoked that a vehicle has a key with: its short answers are dropped at once."""
    key = "gnd/v1/tile/ndt/13033/03021/12388/00000"
    tiles, own = scene.authority.part("tiles", "revoked-tiles"), scene.authority.part("vehicle", "asks-revoked")
    with scene.join(own) as vehicle, scene.join(tiles) as bad, bad.serve(key, lambda _: b"true", complete=True):
        for _ in range(2):
            assert vehicle.request(key, b"which", kind="tile", retry=SOON) == b"true"
        scene.authority.revoke(tiles, own)
        time.sleep(1.2)
        with pytest.raises(RequestFailed, match="was revoked"):
            vehicle.request(key, b"which", kind="tile", retry=SOON, timeout_s=2.0)


def test_attack_downgrade(scene: Scene, sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """A stranger says "sign it" to each question: signatures are stronger, so all that he gets are more bytes."""
    vehicle, _, _ = sealings
    fake = impostor(scene, "gnd/v1/change/**", lambda query: query.reply_err(b"", encoding=SIGNATURE_WANTED))
    try:
        assert [scene.report(f"report {n}".encode()) for n in range(5)] == [b"true"] * 5
    finally:
        fake.undeclare()
    signed = scene.tiles.connection.sealing.answer(TILES, b"true", HeardQuestion(None, bytes(32)))  # type: ignore[union-attr]
    with pytest.raises(SealError, match="no short seal"):  # a short question takes a short answer
        vehicle.check_answer(TILES, TILES, b"true", signed, short_question(vehicle, TILES, b"which"))


def test_attack_keys_of_invented_askers(sealings: tuple[Sealing, Sealing, Sealing]) -> None:
    """Strangers agree on keys by the thousand: those with members stay, and memory is bounded."""
    vehicle, shard, _ = sealings
    granted = GrantedKeys()
    for number in range(200):
        granted.grant(KeyHalf.make().share, number.to_bytes(32, "big"), shard.own, None)
        granted.grant(KeyHalf.make().share, number.to_bytes(32, "big"), shard.own, vehicle.own)
    assert len(granted._unnamed) <= 200
    assert len(granted._named) == KEYS_A_MEMBER
    assert list(granted._of_name) == ["v1"]


def test_renewed_certificates_bring_new_keys(scene: Scene) -> None:
    folder = scene.authority.part("vehicle", "renews")
    with scene.join(folder) as bus:
        for _ in range(2):
            scene.report(b"x", bus)
        sealing = bus.connection.sealing
        assert sealing is not None
        before = agreed_of(sealing, CHANGE)
        renewed = scene.authority.part("vehicle", "renews", folder="renews-again")
        for name in ("certificate.pem", "key.pem"):
            (folder / name).write_bytes((renewed / name).read_bytes())
        sealing.renew(folder)
        assert scene.report(b"x", bus) == b"true"
        assert agreed_of(sealing, CHANGE).key_id != before.key_id


# ---- certificates that an earlier start has learnt


def test_a_new_start_knows_the_certificates(scene: Scene) -> None:
    folder = scene.authority.part("vehicle", "starts-again")
    for expected in (True, False):
        with scene.join(folder) as bus:
            asked: list[str] = []
            sealing = bus.connection.sealing
            assert sealing is not None
            fetch = sealing.fetch
            assert fetch is not None
            sealing.fetch = lambda key, fetch=fetch, asked=asked: asked.append(key) or fetch(key)  # type: ignore[misc]
            assert bus.request(TILES, b"which", kind="tile", retry=SOON) == b"true"
            assert bool(asked) is expected


def test_attack_foreign_certificates_in_the_file(scene: Scene, tmp_path: Path) -> None:
    """Somebody writes a certificate of his own authority, a revoked one, and nonsense into the file of known ones."""
    foreign = load_signer(Authority(tmp_path, scene.authority.name).part("tiles", "t1"))
    revoked = load_signer(revoked_folder := scene.authority.part("tiles", "listed"))
    folder = scene.authority.part("vehicle", "reads-file")
    scene.authority.revoke(revoked_folder, folder)
    entries = b"".join(len(one).to_bytes(2, "little") + one for one in (foreign.chain, revoked.chain))
    (folder / FILE).write_bytes(entries + b"\xff\xffnonsense")
    with scene.join(folder) as bus:
        sealing = bus.connection.sealing
        assert sealing is not None
        assert sealing._certificates.holder(foreign.certificate_id) is None
        assert sealing._certificates.holder(revoked.certificate_id) is None
        assert bus.request(TILES, b"which", kind="tile", retry=SOON) == b"true"
