"""Bytes on the wire, shared out: the lines add up to what TCP_INFO counted, and heads are what the bus really sends."""

import pytest
from bus_testing import wait_for
from hypothesis import given
from hypothesis import strategies as st

from gnd.fleet_bus.ledger import KINDS, Ledger, Share
from gnd.fleet_bus.ledger_file import AgentLedger, Booking, read_ledger
from gnd.fleet_bus.links import load_link
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.fleet_bus.traffic import agent_traffic, fleet_lines
from gnd.fleet_bus.traffic_wire import apportion, wire_account
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

TILE = TileId.from_path("13033/03021/23031/22102")
OTHER = TileId.from_path("13033/03021/23031/22103")


def ledger_of(*bookings: Booking, **wires: WireBytes) -> AgentLedger:
    total = sum(wires.values(), WireBytes())
    return AgentLedger("a", bookings, 1000.0, 100.0, total.up, total.down, 0, wires)


def down(kind: str, size: int, head: int | None = 50, messages: int = 1, session: str = "s") -> Booking:
    return Booking(1.0, 10.0, "down", kind, size, TILE.path if kind == "tile" else None, messages, head, None, session)


def test_lines_of_the_account_by_hand():
    wire = WireBytes(down=5000, down_acks=520, segment_bytes=1000, header_bytes=40)
    account = wire_account(ledger_of(down("tile", 1950), down("ack", 100), s=wire), "down")
    # A tile of 1950 B with a head of 50 B fills two packets of 40 B headers; the small message has one of its own.
    assert account.by_kind == {"ack": 100 + 50 + 40, "tile": 1950 + 50 + 2 * 40}
    assert account.by_tile == {TILE.path: 2080}
    assert (account.rest["acks"], account.rest["resent"]) == (520, 0)
    assert account.rest["session"] == 5000 - 520 - 190 - 2080
    assert (account.measured, account.estimated, account.total) == (5000, 0, 5000)


def test_what_was_sent_again_is_a_line_of_its_own():
    up = Booking(1.0, 10.0, "up", "change", 1000, None, 1, 60, None, "s")
    account = wire_account(ledger_of(up, s=WireBytes(up=3000, up_acks=104, up_resent=700, segment_bytes=1400)), "up")
    assert (account.rest["acks"], account.rest["resent"], account.by_kind) == (104, 700, {"change": 1060})
    assert account.total == 3000


def test_messages_that_travel_together_share_the_room_there_is():
    wire = WireBytes(down=1060, segment_bytes=1000, header_bytes=40)
    account = wire_account(ledger_of(*[down("update", 100, head=20) for _ in range(10)], s=wire), "down")
    assert account.by_kind == {"update": 1060}, "one packet, not ten"
    assert account.rest["session"] == 0


def test_shares_of_a_message_cost_packets_but_no_second_head():
    wire = WireBytes(down=10_000, segment_bytes=1000, header_bytes=40)
    account = wire_account(ledger_of(down("control", 0), down("tile", 1000, head=0, messages=0), s=wire), "down")
    assert account.by_kind == {"control": 50 + 40, "tile": 1000 + 40}


def test_a_ledger_that_knows_no_heads_takes_the_usual_ones():
    account = wire_account(ledger_of(down("ack", 32, head=None), s=WireBytes(down=1000)), "down")
    assert account.by_kind == {"ack": 32 + MESSAGE_OVERHEAD_BYTES}
    assert account.rest["session"] == 1000 - 32 - MESSAGE_OVERHEAD_BYTES


def test_what_no_reading_covers_is_said_to_be_estimated():
    """The first session was killed after its last reading; the second one was read to its end."""
    wires = {"killed": WireBytes(down=300, segment_bytes=1000), "whole": WireBytes(down=700, segment_bytes=1000)}
    bookings = (down("tile", 2000, session="killed"), down("tile", 500, session="whole"))
    account = wire_account(ledger_of(*bookings, **wires), "down")
    assert (account.measured, account.estimated) == (1000, 2050 - 300)
    assert account.rest["session"] == 700 - 550
    assert account.total == account.measured + account.estimated


def test_a_system_that_counts_nothing_gives_estimates_only():
    account = wire_account(ledger_of(down("tile", 2000, head=None)), "down")
    assert (account.measured, account.estimated, account.total) == (0, 2160, 2160)


MESSAGES = st.builds(
    Booking,
    drive_s=st.just(0.0),
    odometer_m=st.just(0.0),
    direction=st.sampled_from(["up", "down"]),
    kind=st.sampled_from(KINDS),
    app_bytes=st.integers(0, 1 << 40),
    tile=st.sampled_from([None, TILE.path, OTHER.path]),
    messages=st.integers(0, 1),
    head_bytes=st.one_of(st.none(), st.integers(0, 300)),
    took_s=st.none(),
    session=st.sampled_from(["s1", "s2"]),
)
COUNT = st.integers(0, 1 << 41)
WIRES = st.builds(
    WireBytes,
    up=COUNT,
    down=COUNT,
    **{
        name: st.integers(0, 9999)
        for name in (
            "up_acks",
            "down_acks",
            "up_resent",
            "up_opening",
            "down_opening",
            "up_alive",
            "down_alive",
            "up_closing",
            "down_closing",
        )
    },
    segment_bytes=st.sampled_from([0, 536, 1448, 65483]),
    header_bytes=st.just(52),
)


@given(st.lists(MESSAGES, max_size=30), st.dictionaries(st.sampled_from(["s1", "s3"]), WIRES))
def test_every_account_adds_up(bookings, wires):
    ledger = ledger_of(*bookings, **wires)
    for direction in ("up", "down"):
        account = wire_account(ledger, direction)
        measured = ledger.wire_up if direction == "up" else ledger.wire_down
        assert account.measured == measured
        assert account.total == measured + account.estimated
        assert min(account.estimated, *account.rest.values()) >= 0
        for kind, size in account.by_kind.items():
            assert size >= sum(b.app_bytes for b in bookings if (b.kind, b.direction) == (kind, direction))
        assert sum(account.by_tile.values()) <= sum(account.by_kind.values())


@given(st.lists(st.floats(0, 1e9), max_size=50), st.integers(0, 1 << 50))
def test_apportioned_numbers_add_up_and_none_is_far_from_its_part(weights, total):
    parts = apportion(total, weights)
    assert len(parts) == len(weights)
    whole = sum(weights)
    if whole <= 0:
        assert set(parts) <= {0}
        return
    assert sum(parts) == total
    assert min(parts) >= 0
    assert all(abs(part - total * w / whole) <= 1 + total * 1e-9 for part, w in zip(parts, weights, strict=True))


def test_the_bus_books_what_it_puts_on_the_wire(router, client, key, tmp_path):
    """Requests, answers and notices of known number and size: little but acknowledgements remains unexplained."""
    file = tmp_path / "a.jsonl"
    ledger = Ledger("a", file)
    server, bus = client(router), client(router, ledger=ledger, link=load_link("none"))
    server.serve(f"{key}/*", lambda request: bytes(3000) if request.payload else bytes(20))
    got: list[str] = []
    bus.subscribe(f"{key}/news/**", lambda key, _payload: got.append(key))
    for number in range(60):
        bus.request(f"{key}/{number:030d}", b"x" * (number % 2), kind="tile", tile=TILE)
        bus.publish(f"{key}/out", bytes(100), kind="control")
    server.publish(f"{key}/news/a", bytes(1000), kind="update")
    wait_for(lambda: got, "the notice")
    total = bus.wire()
    bus.close()
    read = read_ledger(file)
    assert (read.wire_up, read.wire_down) >= (total.up, total.down)
    report = agent_traffic(read, ())
    assert sum(line.wire_bytes for line in report.lines if line.direction == "up") == read.wire_up
    assert sum(line.wire_bytes for line in report.lines if line.direction == "down") == read.wire_down
    assert report.estimated_wire_bytes == 0
    for direction, measured in (("up", read.wire_up), ("down", read.wire_down)):
        booked = [b for b in read.bookings if b.direction == direction]
        stream = sum(b.app_bytes + (b.head_bytes or 0) for b in booked)
        # Beyond payloads, keys and envelopes: the headers of at most two packets a message of either direction (an
        # acknowledgement, or the end of an answer, may have one of its own), and opening and closing.
        assert stream < measured < stream + len(read.bookings) * 2 * 52 + 1500


def test_answers_say_how_long_they_took(router, client, key, tmp_path):
    file = tmp_path / "a.jsonl"
    server, bus = client(router), client(router, ledger=Ledger("a", file), link="3g")
    server.serve(key, lambda _request: bytes(30_000))
    bus.request(key, b"", kind="tile", tile=TILE)
    bus.close()
    read = read_ledger(file)
    assert read.link == load_link("3g")
    arrivals = agent_traffic(read, ()).arrivals
    assert arrivals is not None
    # 30 kB at 5.1 Mbit/s and two delays of 31.75 ms, less the burst that may pass at once.
    assert 2 * 0.03175 < arrivals.longest_s < 10.0
    assert (arrivals.tiles, arrivals.median_s) == (1, arrivals.p95_s)


def test_a_batch_is_one_message_and_its_tiles_have_their_bytes(tmp_path):
    ledger = Ledger("a", tmp_path / "a.jsonl")
    shares = (Share("tile", 40), Share("tile", 9000, TILE), Share("delta", 60, OTHER))
    ledger.record_shares("down", shares, head_bytes=80, took_s=0.25)
    ledger.record_wire(WireBytes(down=10_000, segment_bytes=1448, header_bytes=52))
    report = agent_traffic(read_ledger(tmp_path / "a.jsonl"), ())
    assert [(line.kind, line.messages, line.app_bytes) for line in report.lines] == [
        ("delta", 0, 60),
        ("tile", 1, 9040),
        ("session", 0, 0),
    ]
    assert [(tile.tile, tile.down_bytes) for tile in report.tiles] == [(TILE.path, 9000), (OTHER.path, 60)]
    assert report.down_wire_bytes == 10_000
    assert report.arrivals is not None
    assert (report.arrivals.tiles, report.arrivals.median_s) == (2, 0.25)


def test_lines_of_a_fleet_are_those_of_its_agents(tmp_path):
    reports = []
    for name in ("a", "b"):
        ledger = Ledger(name)
        ledger.record("down", "tile", 1000, TILE)
        ledger.record("up", "change", 70)
        ledger.record_wire(WireBytes(up=200, down=1300))
        ledger.write_jsonl(tmp_path / f"{name}.jsonl")
        reports.append(agent_traffic(read_ledger(tmp_path / f"{name}.jsonl"), ()))
    lines = [(line.kind, line.direction, line.messages, line.app_bytes) for line in fleet_lines(reports)]
    assert lines == [("tile", "down", 2, 2000), ("session", "down", 0, 0), ("change", "up", 2, 140)]
    assert sum(line.wire_bytes for line in fleet_lines(reports)) == 3000


@pytest.mark.parametrize("size", [0, 4, 40])
def test_a_word_about_a_tile_is_no_tile_that_arrived(tmp_path, size):
    ledger = Ledger("a", tmp_path / "a.jsonl")
    ledger.record("down", "tile", size, TILE, took_s=0.1)
    report = agent_traffic(read_ledger(tmp_path / "a.jsonl"), (load_link("3g"),))
    assert report.arrivals is None
    assert report.tile_arrival_s == {"3g": None}


def test_acknowledgements_stand_with_what_they_answer():
    """Ten packets of tiles and five of all else came down, two of them keep-alives: the vehicle sent 15 acks."""
    wire = WireBytes(up=2000, up_acks=15 * 52, down_alive=2 * 55, segment_bytes=1000, header_bytes=52)
    bookings = [down("tile", 9_950), *(down("ack", 40) for _ in range(3))]
    account = wire_account(ledger_of(*bookings, s=wire), "up")
    assert (account.rest["tile acks"], account.rest["acks"]) == (10 * 52, 5 * 52)
    nothing = wire_account(ledger_of(s=wire), "up")
    assert (nothing.rest["tile acks"], nothing.rest["acks"]) == (0, 15 * 52), "two keep-alives, and no tile"


def test_without_anything_that_they_could_answer_acknowledgements_are_nobodys():
    account = wire_account(ledger_of(s=WireBytes(up=104, up_acks=104)), "up")
    assert account.rest == {
        "tile acks": 0,
        "acks": 104,
        "resent": 0,
        "opening": 0,
        "closing": 0,
        "keep-alives": 0,
        "session": 0,
    }
