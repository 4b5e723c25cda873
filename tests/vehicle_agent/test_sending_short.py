"""Reports in short over a real bus: flags, then Gaussians; whatever goes wrong with them, the whole report follows."""

import dataclasses
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import ground, tiles_of
from waiting import wait_until

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import Refused
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, REPORT, decode_measured, encode_mask, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.track import Track, TrackPiece, TrackView
from gnd.schemas.changes import ChangeAck, ChangeReport, TileChange
from gnd.schemas.keys import change_key, change_keys, state_keys, want_key
from gnd.schemas.packed import PackedGaussians, PackedReport, decode_upload
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates, ReportStatus
from gnd.vehicle_agent.link.outbox import FIRST_ASK_S, PATIENT_ASK_S, Outbox, OutboxCounts
from gnd.vehicle_agent.link.sending import SenderThread
from gnd.vehicle_agent.report.packing import pack

NEVER = threading.Event()
REPORT_ID = deterministic_report_id(1_570_838_400_000, "vehicle", "1")
Upload = ChangeReport | PackedReport | PackedGaussians
Opener = Callable[[], SenderThread]


@pytest.fixture(scope="module")
def tile() -> Tile:
    found = tiles_of(ground())
    largest = max(found.values(), key=lambda t: len(t.gaussians))
    return Tile(largest.tile_id, 3, snap(largest.gaussians, LATTICES["standard"]))


@pytest.fixture(scope="module")
def report(tile: Tile) -> ChangeReport:
    """Every tenth voxel of the tile is modified: it holds its neighbour's Gaussian."""
    ids = tile.gaussians.voxel_id[::10]
    moved = tile.gaussians.take(np.arange(len(tile.gaussians))[1::10][: len(ids)])
    n = len(moved)
    changed = snap(Gaussians(ids[:n], moved.count, moved.cells, moved.mean_m, moved.cov_m2), REPORT)
    change = TileChange(
        tile=tile.tile_id,
        base_version=tile.version,
        base_sha=tile.sha,
        observed=tile.gaussians.voxel_id,
        changed=changed,
        change_class=np.full(n, ChangeClass.MODIFIED, np.uint8),
        evidence=np.zeros((n, 4), np.int32),
        pose_sigma_m=0.02,
        pose_sigma_rad=0.001,
    )
    return ChangeReport(REPORT_ID, "vehicle", "VLP-16", "test", tile.tile_id.district, 1, 2, (change,))


@pytest.fixture
def outbox(tmp_path: Path, tile: Tile, report: ChangeReport) -> Outbox:
    """With the report, whole and in short."""
    box = Outbox(tmp_path / "outbox.sqlite")
    view = TrackView((-30, -24, -18, -12, -6, 0, 6, 12, 20))
    track = Track(report.district, view, (TrackPiece(np.zeros((1, 3), np.int32), 5),))
    packed = pack(report, {tile.sha: tile.gaussians}, track).encode()
    box.put(REPORT_ID, change_key("ndt", report.district), report.encode(), packed, [tile])
    return box


@pytest.fixture
def start(bus: Bus, outbox: Outbox) -> Iterator[Opener]:
    opened: list[SenderThread] = []

    def open_sender() -> SenderThread:
        opened.append(SenderThread(bus, outbox, "vehicle"))
        return opened[-1]

    yield open_sender
    bus.close()
    for sender in opened:
        sender.close()


Told = ReportState | Exception


class Script:
    """Acknowledges each message and tells the next line of a script, also to who asks; remembers what came."""

    def __init__(self, cloud: Bus, *lines: Told) -> None:
        self.cloud, self.lines, self.heard = cloud, list(lines), list[Upload]()

    def __call__(self, request: Request) -> bytes:
        self.heard.append(decode_upload(request.payload))
        line = self.lines.pop(0)
        if isinstance(line, Exception):
            raise line
        self.last = line
        self.cloud.publish(want_key("vehicle"), ReportStates((line,)).encode(), kind="ack")
        return ChangeAck(REPORT_ID, "stored").encode()

    def state(self, _request: Request) -> bytes:
        return ReportStates((self.last,)).encode()

    @property
    def kinds(self) -> list[str]:
        return [type(upload).__name__ for upload in self.heard]


def told(status: ReportStatus, wanted: bytes = b"") -> ReportState:
    return ReportState(REPORT_ID, status, wanted, "a reason" if status in ("quarantined", "resend") else "")


def some(report: ChangeReport) -> np.ndarray:
    return np.arange(len(report.tiles[0].changed)) % 3 == 0


FORMS = {"flags": "PackedReport", "gaussians": "PackedGaussians", "whole": "ChangeReport"}


def run(start: Opener, cloud: Bus, script: Script) -> None:
    cloud.serve(change_keys(), script, workers=1)
    cloud.serve(state_keys(), script.state)  # a notice may overtake the ack, and is asked for then
    sender = start()
    assert sender.drain(20.0, NEVER)
    assert Counter({FORMS[form]: n for form, n in sender.counts.items() if form in FORMS}) == Counter(script.kinds)


def test_what_the_cloud_has_enough_of_is_one_message(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    run(start, cloud, script := Script(cloud, told("released")))
    (packed,) = script.heard
    assert isinstance(packed, PackedReport)
    assert len(packed.encode()) < len(report.encode()) / 10
    assert outbox.counts().acknowledged == 1
    assert outbox.bases_of(REPORT_ID) == {}


def test_the_gaussians_that_are_asked_for_follow_and_no_others(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, tile: Tile
) -> None:
    mask = some(report)
    run(start, cloud, script := Script(cloud, told("wanted", encode_mask(mask)), told("released")))
    assert script.kinds == ["PackedReport", "PackedGaussians"]
    second = script.heard[1]
    assert isinstance(second, PackedGaussians)
    expected = report.tiles[0].changed.take(mask)
    assert decode_measured([(tile.tile_id, tile.gaussians, expected.voxel_id)], second.measured) == [expected]
    assert outbox.counts().acknowledged == 1


def packed_with(tile: Tile, report: ChangeReport, *, is_last: bool) -> bytes:
    """The report in short with all its Gaussians."""
    view = TrackView((-30, -24, -18, -12, -6, 0, 6, 12, 20))
    track = Track(report.district, view, (TrackPiece(np.zeros((1, 3), np.int32), 5),))
    return pack(report, {tile.sha: tile.gaussians}, track, 1 << 20, is_last=is_last).encode()


def test_a_merger_of_before_asks_for_gaussians_that_it_did_not_see_and_gets_them(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, tile: Tile
) -> None:
    outbox._db.run("UPDATE packed SET body = ?", (packed_with(tile, report, is_last=True),))
    run(start, cloud, script := Script(cloud, told("wanted", encode_mask(some(report))), told("released")))
    assert script.kinds == ["PackedReport", "PackedGaussians"]
    assert outbox.counts().acknowledged == 1


def number_two(report: ChangeReport) -> ChangeReport:
    return dataclasses.replace(report, report_id=deterministic_report_id(1_570_838_400_001, "vehicle", "2"))


def test_word_of_a_patient_report_comes_with_the_ack_of_the_next_and_is_not_asked_for_meanwhile(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, tile: Tile
) -> None:
    outbox._db.run("UPDATE packed SET body = ?", (packed_with(tile, report, is_last=False),))
    other, asked = number_two(report), []

    def answer(request: Request) -> bytes:
        upload = decode_upload(request.payload)
        if upload.report_id == REPORT_ID:
            return ChangeAck(REPORT_ID, "stored").encode()
        released = tuple(ReportState(one, "released") for one in (REPORT_ID, upload.report_id))
        cloud.publish(want_key("vehicle"), ReportStates(released[1:]).encode(), kind="ack")
        return ChangeAck(upload.report_id, "stored", told=released[:1]).encode()

    def state(request: Request) -> bytes:
        asked.extend(ReportQuestion.decode(request.payload).report_ids)
        return ReportStates(tuple(ReportState(one, "released") for one in asked)).encode()

    cloud.serve(change_keys(), answer, workers=1)
    cloud.serve(state_keys(), state)
    sender = start()
    wait_until(lambda: outbox.counts().held)
    time.sleep(FIRST_ASK_S + 1.0)
    assert (outbox.counts().held, asked) == (1, []), "a vehicle that is told at once asks after 4 s"
    outbox.put(other.report_id, change_key("ndt", report.district), other.encode())
    wait_until(lambda: outbox.states()[REPORT_ID] == "released")
    assert outbox.bases_of(REPORT_ID) == {}
    assert sender.drain(20.0, NEVER)
    assert REPORT_ID not in asked


def test_the_end_of_a_drive_does_not_wait_for_an_ack_that_will_not_come(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, tile: Tile
) -> None:
    outbox._db.run("UPDATE packed SET body = ?", (packed_with(tile, report, is_last=False),))
    cloud.serve(change_keys(), lambda _: ChangeAck(REPORT_ID, "stored").encode(), workers=1)
    cloud.serve(state_keys(), lambda _: ReportStates((told("released"),)).encode())
    sender = start()
    wait_until(lambda: outbox.counts().held)
    assert sender.drain(PATIENT_ASK_S / 4, NEVER)
    assert outbox.states() == {REPORT_ID: "released"}


def test_word_in_an_ack_about_a_report_that_is_not_here_changes_nothing(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    stranger = ReportState(number_two(report).report_id, "quarantined", reason="no")
    cloud.serve(change_keys(), lambda _: ChangeAck(REPORT_ID, "stored", told=(stranger,)).encode(), workers=1)
    cloud.serve(state_keys(), lambda _: ReportStates((told("released"),)).encode())
    assert start().drain(20.0, NEVER)
    assert outbox.states() == {REPORT_ID: "released"}


def test_gaussians_are_made_long_after_the_ack_of_their_flags(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    script = Script(cloud, told("waiting"), told("released"))
    cloud.serve(change_keys(), script, workers=1)
    sender = start()
    wait_until(lambda: outbox.counts().held)
    assert not sender.drain(1.0, NEVER)
    notice = ReportStates((told("wanted", encode_mask(some(report))),)).encode()
    cloud.publish(want_key("vehicle"), notice, kind="ack")
    assert sender.drain(10.0, NEVER)
    assert script.kinds == ["PackedReport", "PackedGaussians"]


@pytest.mark.parametrize(
    "line", [told("resend"), told("quarantined"), Refused("only whole reports here"), told("wanted", b"no mask at all")]
)
def test_flags_that_are_not_understood_are_followed_by_the_whole_report(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, line: Told
) -> None:
    run(start, cloud, script := Script(cloud, line, told("released")))
    assert script.kinds == ["PackedReport", "ChangeReport"]
    assert script.heard[-1] == report
    assert outbox.counts().acknowledged == 1


def test_flags_that_are_refused_instead_of_acknowledged_are_followed_by_the_whole_report(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    heard = []

    def answer(request: Request) -> bytes:
        heard.append(decode_upload(request.payload))
        return ChangeAck("" if len(heard) == 1 else REPORT_ID, "quarantined", "a reason").encode()

    cloud.serve(change_keys(), answer, workers=1)
    assert start().drain(20.0, NEVER)
    assert [type(upload).__name__ for upload in heard] == ["PackedReport", "ChangeReport"]
    assert outbox.refused() == [(REPORT_ID, "a reason")], "only the refusal of the whole counts"


def test_refused_gaussians_are_followed_by_the_whole_report_and_only_its_refusal_counts(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    lines = told("wanted", encode_mask(some(report))), told("resend"), told("quarantined")
    run(start, cloud, script := Script(cloud, *lines))
    assert script.kinds == ["PackedReport", "PackedGaussians", "ChangeReport"]
    assert outbox.refused() == [(REPORT_ID, "a reason")]


def test_bases_damaged_on_the_disk_cost_only_bytes(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    outbox._db.run("UPDATE base SET body = x'00'")
    run(start, cloud, script := Script(cloud, told("wanted", encode_mask(some(report))), told("released")))
    assert script.kinds == ["PackedReport", "ChangeReport"]
    assert outbox.counts().acknowledged == 1


def test_an_agent_killed_after_the_ack_of_its_flags_asks_what_is_wanted_and_sends_it(
    start: Opener, outbox: Outbox, cloud: Bus, endpoint: str, report: ChangeReport, tmp_path: Path
) -> None:
    """The first life is acknowledged and dies before it hears what is wanted."""
    heard, wanted = list[Upload](), told("wanted", encode_mask(some(report)))

    def answer(request: Request) -> bytes:
        heard.append(decode_upload(request.payload))
        if isinstance(heard[-1], PackedGaussians):
            cloud.publish(want_key("vehicle"), ReportStates((told("released"),)).encode(), kind="ack")
        return ChangeAck(REPORT_ID, "stored").encode()

    cloud.serve(change_keys(), answer, workers=1)
    program = textwrap.dedent(
        f"""
        import threading
        from pathlib import Path
        from gnd.fleet_bus.bus import open_bus
        from gnd.fleet_bus.config import BusConfig
        from gnd.vehicle_agent.link.outbox import Outbox
        from gnd.vehicle_agent.link.sending import SenderThread
        with open_bus(BusConfig(connect=({endpoint!r},)), name="first") as bus:
            SenderThread(bus, Outbox(Path({str(tmp_path / "outbox.sqlite")!r})), "vehicle")
            threading.Event().wait(60)
        """
    )
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        wait_until(lambda: outbox.counts().held, timeout_s=40.0)
        process.kill()
    assert (outbox.counts().held, len(outbox.bases_of(REPORT_ID))) == (1, 1)
    cloud.serve(state_keys(), lambda _: ReportStates((wanted,)).encode())
    assert start().drain(30.0, NEVER)
    assert [type(upload).__name__ for upload in heard] == ["PackedReport", "PackedGaussians"]
    assert outbox.counts() == OutboxCounts(pending=0, acknowledged=1, quarantined=0)


def test_a_report_that_cannot_be_packed_goes_whole_at_once(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    other = dataclasses.replace(report, report_id=deterministic_report_id(1_570_838_400_001, "vehicle", "2"))
    outbox.told(told("released"), 0)
    outbox.put(other.report_id, change_key("ndt", report.district), other.encode())
    heard = []

    def answer(request: Request) -> bytes:
        heard.append(decode_upload(request.payload))
        released = ReportStates((ReportState(other.report_id, "released"),)).encode()
        cloud.publish(want_key("vehicle"), released, kind="ack")
        return ChangeAck(other.report_id, "stored").encode()

    cloud.serve(change_keys(), answer)
    assert start().drain(20.0, NEVER)
    assert heard == [other]
