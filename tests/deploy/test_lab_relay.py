"""The relay: what it does to packets, with given clocks and over real descriptors."""

import json
import random
import socket
import threading
import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gnd.deploy.lab.relay import Jitter, Line, LineCount, Wire, carry, read_account
from gnd.fleet_bus.links import LinkProfile

STEPS = st.lists(st.floats(0, 0.2), min_size=1, max_size=200)


@given(STEPS, st.floats(0.001, 0.05), st.integers(0, 1000))
def test_jitter_stays_within_its_bounds_and_never_lets_a_packet_overtake(steps, amplitude_s, seed):
    jitter = Jitter(amplitude_s, random.Random(seed))
    times_s = 1000 + np.cumsum(steps)
    offsets_s = np.array([jitter.at(float(t)) for t in times_s])
    assert np.abs(offsets_s).max() <= amplitude_s * (1 + 1e-9)
    assert np.diff(times_s + offsets_s).min(initial=0.0) >= -1e-9


def test_jitter_is_even_about_the_mean():
    jitter = Jitter(0.01, random.Random(1))
    offsets_s = np.array([jitter.at(n * 0.001) for n in range(200_000)])
    assert abs(offsets_s.mean()) < 0.0005
    assert 0.004 < offsets_s.std() < 0.006
    assert Jitter(0.0, random.Random(1)).at(5.0) == 0.0


@given(STEPS, st.floats(0, 50), st.floats(0, 1), st.floats(0, 0.9), st.integers(0, 1000))
def test_every_packet_is_lost_or_delivered_once_in_order_and_not_too_early(steps, delay_ms, part, loss, seed):
    link = LinkProfile("x", delay_ms=delay_ms, jitter_ms=part * delay_ms, loss=loss)
    line = Line(link, random.Random(seed))
    delivered: list[tuple[int, float]] = []
    now_s, sent_s = 0.0, []
    for number, step in enumerate(steps):
        now_s += step
        line.deliver(now_s, lambda packet, now_s=now_s: delivered.append((int(packet), now_s)))
        line.take(str(number).encode(), now_s)
        sent_s.append(now_s)
    line.deliver(now_s + 1, lambda packet: delivered.append((int(packet), now_s + 1)))
    numbers = [number for number, _ in delivered]
    assert numbers == sorted(set(numbers))
    assert len(numbers) + line.count.lost == len(steps)
    assert line.next_due_s is None
    least_s = (delay_ms - link.jitter_ms) / 1000
    assert all(at_s - sent_s[number] >= least_s - 1e-9 for number, at_s in delivered)
    assert line.count.packets == len(numbers)
    assert line.count.size_bytes == sum(len(str(number)) for number in numbers)


def test_the_share_of_lost_packets_is_the_profile_s():
    line = Line(LinkProfile("x", loss=0.01), random.Random(5))
    for _ in range(100_000):
        line.take(b"x", 0.0)
    assert abs(line.count.lost - 1000) < 6 * 1000**0.5


def pair() -> tuple[socket.socket, socket.socket]:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    one.setblocking(False)
    return one, other


def test_packets_pass_between_real_descriptors_after_their_delay():
    (source, sender), (target, receiver) = pair(), pair()
    with source, sender, target, receiver:
        wire = Wire("v00", source.fileno(), target.fileno(), Line(LinkProfile("x", delay_ms=30), random.Random(1)))
        sent_s = time.monotonic()
        for number in range(5):
            sender.send(bytes([number]))
        while wire.line.count.packets < 5:
            carry([wire], 1.0)
            assert time.monotonic() - sent_s < 30
        assert time.monotonic() - sent_s >= 0.03
        assert [receiver.recv(10)[0] for _ in range(5)] == [0, 1, 2, 3, 4]
        assert wire.line.count.delay_max_s >= 0.03


def test_what_the_receiver_does_not_take_is_counted_and_does_no_harm():
    (source, sender), (target, receiver) = pair(), pair()
    with source, sender, target:
        wire = Wire("v00", source.fileno(), target.fileno(), Line(LinkProfile("x"), random.Random(1)))
        receiver.close()
        sender.send(b"lost")
        carry([wire], 1.0)
        assert (wire.line.count.packets, wire.line.count.refused) == (0, 1)


def test_carrying_comes_back_when_nothing_happens():
    source, sender = pair()
    with source, sender:
        wire = Wire("v00", source.fileno(), source.fileno(), Line(LinkProfile("x"), random.Random(1)))
        done = threading.Event()
        thread = threading.Thread(target=lambda: (carry([wire], 0.05), done.set()))
        thread.start()
        assert done.wait(30)
        thread.join()


def test_a_restarted_relay_goes_on_with_the_account(tmp_path):
    for number, packets in (("1", 3), ("2", 4)):
        values = {"v00": {**LineCountValues, "packets": packets, "delay_max_s": packets / 10}}
        (tmp_path / f"relay-{number}.json").write_text(json.dumps(values))
    assert read_account(tmp_path) == {"v00": LineCount(packets=7, delay_max_s=0.4)}
    assert read_account(tmp_path / "absent") == {}


LineCountValues = {
    "packets": 0, "size_bytes": 0, "lost": 0, "refused": 0, "delay_sum_s": 0.0, "delay_max_s": 0.0,
}  # fmt: skip
