"""Profiles of mobile links and the pacer that imitates them."""

import math
import threading
import time
from dataclasses import replace

import pytest
from bus_testing import Inbox, wait_for
from hypothesis import given
from hypothesis import strategies as st

from gnd.fleet_bus.errors import BusClosed, LinkError
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.links import SEGMENT_BYTES, UNLIMITED, LinkProfile, load_link, read_links
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES, Bucket, Pacer


@pytest.mark.parametrize("name", ["3g", "4g", "5g"])
def test_each_profile_says_where_its_figures_come_from(name):
    link = load_link(name)
    assert link.name == name
    for source in (link.rate_source, link.delay_source, link.jitter_source, link.loss_source):
        assert source.startswith(("quoted: ", "assumed: "))
    assert math.isfinite(link.down_bit_s)
    assert link.down_bit_s > link.up_bit_s > 0


def test_generations_get_faster():
    links = [load_link(name) for name in ("3g", "4g", "5g")]
    assert sorted(links, key=lambda link: link.down_bit_s) == links
    assert sorted(links, key=lambda link: link.up_bit_s) == links
    assert sorted(links, key=lambda link: -link.delay_ms) == links


def test_none_is_no_limit():
    assert load_link("none") is UNLIMITED
    assert UNLIMITED.is_unlimited
    assert load_link(UNLIMITED) is UNLIMITED


def test_a_link_that_the_network_shapes_keeps_its_figures_but_is_not_paced():
    shaped = replace(load_link("3g"), paced=False)
    assert shaped.is_unlimited
    assert shaped.rate_byte_s("up") == load_link("3g").rate_byte_s("up")
    assert not load_link("3g").is_unlimited


def test_a_file_of_ones_own(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[satellite]\ndown_bit_s = 1e6\nup_bit_s = 200_000\ndelay_ms = 300\n")
    assert load_link(str(file)).delay_s == 0.3
    assert load_link(f"{file}:satellite").rate_byte_s("up") == 25_000
    file.write_text(file.read_text() + "[barge]\nup_bit_s = 1\n")
    assert list(read_links(file)) == ["satellite", "barge"]
    with pytest.raises(LinkError, match="there are: none, satellite, barge"):
        load_link(str(file))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[x]\ndown_bit_s = 0", "rates must be positive, got 0"),
        ("[x]\nloss = 1.5", r"loss must be in \[0, 1\), got 1.5"),
        ("[x]\ndelay_ms = -1", "delay_ms must be 0 or more"),
        ("[x]\ndelay_ms = 3\njitter_ms = 4", r"jitter_ms must be in 0 … delay_ms \(3"),
        ("[x]\nbatch_bytes = 70000", "batch_bytes must be in 512 … 65535, got 70000"),
        ("[x]\nlease_ms = 1", "lease below 100 ms"),
        ("[x]\ndown = 1", "unknown key down"),
        ("x = 3", "expected a table, got 3"),
        ("[x", "cannot read link profiles"),
    ],
)
def test_malformed_profiles_are_named(tmp_path, text, words):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(LinkError, match=words):
        load_link(str(file))


def test_unknown_profiles_and_files_are_named(tmp_path):
    with pytest.raises(LinkError, match="no link profile '6g'; there are: none, 3g, 4g, 5g"):
        load_link("6g")
    with pytest.raises(LinkError, match=r"cannot read link profiles from .*absent.toml"):
        load_link(str(tmp_path / "absent.toml"))


def test_a_bucket_sends_one_after_the_other():
    bucket = Bucket(rate_byte_s=1000, burst_bytes=0)
    assert bucket.book(10.0, 500) == pytest.approx(10.5)
    assert bucket.book(10.0, 500) == pytest.approx(11.0)
    assert bucket.book(20.0, 500) == pytest.approx(20.5)


def test_an_idle_bucket_saves_up_one_burst_and_no_more():
    bucket = Bucket(rate_byte_s=1000, burst_bytes=300)
    assert bucket.book(100.0, 300) == 100.0
    assert bucket.book(100.0, 500) == pytest.approx(100.5)


SIZES = st.lists(st.tuples(st.floats(0, 10), st.integers(1, 100_000)), min_size=1, max_size=50)


@given(SIZES, st.floats(100, 1e7), st.integers(0, 50_000))
def test_a_bucket_keeps_order_and_never_exceeds_its_rate(messages, rate_byte_s, burst_bytes):
    bucket = Bucket(rate_byte_s, burst_bytes)
    now_s, sent, last_s = 0.0, 0, -math.inf
    for pause_s, size in messages:
        now_s += pause_s
        done_s = bucket.book(now_s, size)
        sent += size
        assert done_s >= now_s
        assert done_s >= last_s
        assert sent <= done_s * rate_byte_s * (1 + 1e-9) + burst_bytes + 1e-6
        last_s = done_s


def pacer(link: LinkProfile, **more) -> Pacer:
    return Pacer(link, threading.Event(), clock=lambda: 5.0, **more)


def test_a_message_takes_its_bytes_its_overhead_and_the_delay():
    link = LinkProfile("test", down_bit_s=80_000, up_bit_s=8000, delay_ms=100, burst_bytes=0)
    size = 1000 - MESSAGE_OVERHEAD_BYTES
    assert pacer(link).delay_s("down", size) == pytest.approx(0.1 + 0.1)
    assert pacer(link).delay_s("up", size) == pytest.approx(1.0 + 0.1)


def test_directions_do_not_wait_for_each_other():
    both = pacer(LinkProfile("test", down_bit_s=8000, up_bit_s=8000, burst_bytes=0))
    assert both.delay_s("up", 10_000) > 10
    assert both.delay_s("down", 840) == pytest.approx(1.0)


def test_lost_packets_are_sent_again_and_cost_a_round_trip():
    clean = LinkProfile("clean", down_bit_s=8e6, up_bit_s=8e6, delay_ms=50, burst_bytes=0)
    lossy = LinkProfile("lossy", down_bit_s=8e6, up_bit_s=8e6, delay_ms=50, burst_bytes=0, loss=0.5)
    size = 100 * SEGMENT_BYTES
    extra_s = pacer(lossy, seed=1).delay_s("down", size) - pacer(clean).delay_s("down", size)
    again = (extra_s - 2 * 0.05) * 1e6 / SEGMENT_BYTES
    assert again == pytest.approx(round(again))
    assert 35 <= again <= 65
    assert pacer(lossy, seed=1).delay_s("down", size) == pacer(lossy, seed=1).delay_s("down", size)


def test_closing_ends_the_wait_for_a_slow_link():
    closed = threading.Event()
    slow = Pacer(LinkProfile("slow", down_bit_s=8, up_bit_s=8), closed)
    outcome = []

    def wait() -> None:
        try:
            slow.wait("up", 1_000_000)
        except BusClosed as error:
            outcome.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    closed.set()
    waiting.join(5)
    assert len(outcome) == 1


SLOW = LinkProfile("slow", down_bit_s=4e6, up_bit_s=8e5, delay_ms=20, burst_bytes=0)


def test_requests_pass_the_link_both_ways(router, client, key):
    """A lower bound: 10 kB up at 100 kB/s, 50 kB down at 500 kB/s, and the delay twice."""
    server, bus = client(router), client(router, link=SLOW, ledger=Ledger("a"))
    server.serve(key, lambda _request: bytes(50_000))
    start_s = time.monotonic()
    bus.request(key, bytes(10_000), kind="tile")
    assert time.monotonic() - start_s >= 0.1 + 0.1 + 2 * 0.02


def test_notices_pass_the_link_in_order(router, client, key):
    sender, receiver = client(router), client(router, link=SLOW)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    start_s = time.monotonic()
    for number in range(4):
        sender.publish(key, bytes([number]) + bytes(24_999), kind="update")
    wait_for(lambda: len(inbox.items) == 4, "four notices")
    assert time.monotonic() - start_s >= 4 * 0.05
    assert [payload[0] for payload in inbox.payloads] == [0, 1, 2, 3]


def test_publishing_waits_for_the_uplink(router, client, key):
    bus = client(router, link=SLOW)
    start_s = time.monotonic()
    bus.publish(key, bytes(20_000), kind="control")
    assert time.monotonic() - start_s >= 0.2 + 0.02
