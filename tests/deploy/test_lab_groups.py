"""Groups of a lab, the commands that shape its links, and what is read back from the kernel's tools."""

import math

import pytest
from lab_testing import profile_file

from gnd.deploy.errors import LabError
from gnd.deploy.lab.counters import parse_ss
from gnd.deploy.lab.devices import MTU_BYTES, link_commands, netem_words, tbf_words
from gnd.deploy.lab.groups import LabLink, check_lab_name, links_of, parse_groups, unpaced
from gnd.deploy.lab.lab import relayed_links
from gnd.deploy.lab.sampler import LinkSeen
from gnd.deploy.lab.tools import Offer, check_offer, needs_carrying
from gnd.fleet_bus.errors import LinkError
from gnd.fleet_bus.links import LinkProfile, load_link

SLOW = LinkProfile("slow", down_bit_s=4e6, up_bit_s=1e6, delay_ms=30, jitter_ms=5, loss=0.01)


def test_groups_number_their_vehicles_one_after_the_other():
    groups = parse_groups("3g:2, 4g:4,5g:2")
    assert [(g.name, g.first, g.count) for g in groups] == [("3g", 0, 2), ("4g", 2, 4), ("5g", 6, 2)]
    links = links_of("x", groups)
    assert [link.number for link in links] == list(range(8))
    assert [link.profile.name for link in links] == ["3g"] * 2 + ["4g"] * 4 + ["5g"] * 2
    assert len({link.vehicle_namespace for link in links}) == 3
    assert {link.cloud_namespace for link in links} == {"gndlab.x.cloud"}
    addresses = [address for link in links for address in (link.vehicle_address, link.cloud_address)]
    assert len(set(addresses)) == 16


def test_a_profile_may_make_several_groups_and_come_from_a_file(tmp_path):
    file = profile_file(tmp_path, '["Rural LTE"]\ndown_bit_s = 5e6\n[b]\n')
    groups = parse_groups(f"4g:1,4g:1,{file}:Rural LTE:3,none:1")
    assert [group.name for group in groups] == ["4g", "4g-2", "rural-lte", "none"]
    assert groups[2].link.down_bit_s == 5e6
    assert groups[2].count == 3


def test_no_group_is_called_like_the_cloud(tmp_path):
    file = profile_file(tmp_path, "[cloud]\n")
    (link,) = links_of("x", parse_groups(f"{file}:1"))
    assert link.vehicle_namespace != link.cloud_namespace


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "hold 0 vehicles: it must be 1 to 200"),
        ("4g", "group '4g' is not like 4g:2"),
        ("4g:0", "group '4g:0' is not like"),
        ("4g:-1", "group '4g:-1' is not like"),
        ("4g:x", "group '4g:x' is not like"),
        (":3", "group ':3' is not like"),
        ("3g:150,4g:51", "hold 201 vehicles: it must be 1 to 200"),
    ],
)
def test_malformed_groups_are_named(text, words):
    with pytest.raises(LabError, match=words):
        parse_groups(text)


def test_unknown_profiles_are_named():
    with pytest.raises(LinkError, match="no link profile '6g'; there are: none, 3g"):
        parse_groups("6g:1")


@pytest.mark.parametrize("name", ["", "A", "a.b", "-a", "a b", "a/b", "x" * 21])
def test_names_that_make_no_namespace_are_refused(name):
    with pytest.raises(LabError, match="a lab's name is 1 to 20 of a-z"):
        check_lab_name(name)


def test_a_vehicle_keeps_its_figures_but_does_not_pace():
    link = unpaced(load_link("3g"))
    assert link.is_unlimited
    assert (link.down_bit_s, link.delay_ms, link.lease_ms) == (5.1e6, 31.75, 60_000)


def test_every_profile_fits_the_buckets_that_the_kernel_takes():
    for name in ("3g", "4g", "5g"):
        link = load_link(name)
        for direction in ("up", "down"):
            words = tbf_words(link.rate_byte_s(direction) * 8, link.burst_bytes)
            assert words[:3] == ("tbf", "rate", f"{round(link.rate_byte_s(direction) * 8)}bit")
            burst, limit = int(words[4].removesuffix("b")), int(words[6].removesuffix("b"))
            assert MTU_BYTES < burst < limit


def test_netem_takes_the_same_figures():
    assert netem_words(SLOW)[3:] == ("delay", "30000us", "5000us", "loss", "random", "1.000000%")
    assert netem_words(LinkProfile("plain", delay_ms=30))[3:] == ("delay", "30000us")


def test_netem_hangs_below_the_bucket_and_stands_alone_without_one():
    link = LabLink(0, SLOW, "a", "b")
    lines = [" ".join(command) for command in link_commands(link, relayed=False)]
    assert any("dev v00 root handle 1: tbf rate 1000000bit" in line for line in lines)
    assert any("dev c00 root handle 1: tbf rate 4000000bit" in line for line in lines)
    assert sum("parent 1:1 handle 10: netem" in line for line in lines) == 2
    lone = LabLink(0, LinkProfile("late", delay_ms=9), "a", "b")
    lines = [" ".join(command) for command in link_commands(lone, relayed=False)]
    assert sum("root handle 10: netem" in line for line in lines) == 2


def test_a_relayed_link_is_a_pair_of_tuns_without_netem():
    lines = [" ".join(command) for command in link_commands(LabLink(3, SLOW, "a", "b"), relayed=True)]
    assert lines[0] == "ip -n a tuntap add dev v03 mode tun"
    assert not any("netem" in line or "veth" in line for line in lines)


@pytest.mark.parametrize(
    ("offer", "link", "words"),
    [
        (Offer(tbf=False, netem=True, tun=True), LinkProfile("x"), "no tbf.*sch_tbf"),
        (Offer(tbf=True, netem=False, tun=False), SLOW, "sch_netem, or /dev/net/tun"),
    ],
)
def test_a_kernel_that_cannot_shape_is_refused(offer, link, words):
    with pytest.raises(LabError, match=words):
        check_offer(offer, (link,))


def test_a_rate_alone_needs_neither_netem_nor_tun():
    rate_only = LinkProfile("x", down_bit_s=1e6)
    assert not needs_carrying(rate_only)
    check_offer(Offer(tbf=True, netem=False, tun=False), (rate_only,))


def test_a_relay_carries_what_netem_cannot():
    links = (LabLink(0, SLOW, "a", "b"), LabLink(1, LinkProfile("x", down_bit_s=1e6), "a", "b"))
    with_netem, without = Offer(tbf=True, netem=True, tun=True), Offer(tbf=True, netem=False, tun=True)
    assert relayed_links(links, with_netem, relay_all=False) == ()
    assert relayed_links(links, with_netem, relay_all=True) == links[:1]
    assert relayed_links(links, without, relay_all=False) == links[:1]


SS = (
    "0      34200  198.18.0.2:42081 198.18.0.1:34849 bbr wscale:10,10 rto:204 rtt:0.127/0.198 mss:1400 "
    "bytes_sent:89600 bytes_retrans:1400 bytes_acked:65801 retrans:0/1 rcv_rtt:1.5 minrtt:0.004 snd_wnd:23552"
)


def test_what_tcp_says_is_read():
    sample = parse_ss(SS)
    assert sample is not None
    assert (sample.local, sample.rtt_ms, sample.min_rtt_ms) == ("198.18.0.2:42081", 0.127, 0.004)
    assert (sample.sent_bytes, sample.resent_bytes) == (89_600, 1_400)
    assert parse_ss("0 0 198.18.0.2:42081 198.18.0.1:34849 cubic wscale:10,10") is None
    assert parse_ss("") is None


def test_the_peak_is_the_best_whole_second():
    seen = LinkSeen()
    sent = 0
    for tenth in range(41):  # 1 s idle, 1 s at 1000 B/s, 2 s idle
        sent += 100 if 10 < tenth <= 20 else 0
        seen.counted(tenth / 10, sent, 2 * sent)
    assert math.isclose(seen.peak_bit_s["up"], 8000, rel_tol=0.11)
    assert math.isclose(seen.peak_bit_s["down"], 16_000, rel_tol=0.11)


def test_what_was_sent_again_is_a_share_of_all_connections_seen():
    seen = LinkSeen()
    assert seen.resent_share("up") is None
    first, second = parse_ss(SS), parse_ss(SS.replace("42081", "42082").replace("retrans:1400", "retrans:0"))
    assert first is not None
    assert second is not None
    for sample in (first, first, second):
        seen.tcp("up", sample)
    assert seen.resent_share("up") == 1400 / (2 * 89_600)
    assert seen.median_ms() == 0.127
