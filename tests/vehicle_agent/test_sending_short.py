"""Reports in short over a real bus: flags, then Gaussians; whatever goes wrong with them, the whole report follows."""

import dataclasses
import subprocess
import sys
import textwrap
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import ground, tiles_of
from waiting import wait_until

from fleet_bus.bus import Bus
from fleet_bus.errors import Refused
from fleet_bus.serving import Request
from gnd_map.classes import ChangeClass
from gnd_map.codec import LATTICES, REPORT, decode_measured, encode_mask, snap
from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.track import Piece, Track, View
from schemas.changes import ChangeAck, ChangeReport, TileChange
from schemas.keys import change_key, change_keys
from schemas.packed import PackedGaussians, PackedReport, decode_upload
from schemas.report_id import deterministic_report_id
from vehicle_agent.outbox import Outbox
from vehicle_agent.packing import pack
from vehicle_agent.sending import SenderThread

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
    view = View((-30, -24, -18, -12, -6, 0, 6, 12, 20))
    track = Track(report.district, view, (Piece(np.zeros((1, 3), np.int32), 5),))
    packed = pack(report, {tile.sha: tile.gaussians}, track).encode()
    box.put(REPORT_ID, change_key("ndt", report.district), report.encode(), packed, [tile])
    return box


@pytest.fixture
def start(bus: Bus, outbox: Outbox) -> Iterator[Opener]:
    opened: list[SenderThread] = []

    def open_sender() -> SenderThread:
        opened.append(SenderThread(bus, outbox))
        return opened[-1]

    yield open_sender
    bus.close()
    for sender in opened:
        sender.close()


class Script:
    """Answers each message by the next line of a script and remembers what came."""

    def __init__(self, *answers: ChangeAck | Exception) -> None:
        self.answers, self.heard = list(answers), list[Upload]()

    def __call__(self, request: Request) -> bytes:
        self.heard.append(decode_upload(request.payload))
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer.encode()

    @property
    def kinds(self) -> list[str]:
        return [type(upload).__name__ for upload in self.heard]


def ack(status: str, wanted: bytes = b"", report_id: str = REPORT_ID) -> ChangeAck:
    return ChangeAck(report_id, status, "a reason" if status in ("quarantined", "resend") else "", wanted)  # type: ignore[arg-type]


def some(report: ChangeReport) -> np.ndarray:
    return np.arange(len(report.tiles[0].changed)) % 3 == 0


FORMS = {"flags": "PackedReport", "gaussians": "PackedGaussians", "whole": "ChangeReport"}


def run(start: Opener, cloud: Bus, script: Script) -> None:
    cloud.serve(change_keys(), script, workers=1)
    sender = start()
    assert sender.drain(20.0, NEVER)
    assert Counter({FORMS[form]: n for form, n in sender.counts.items()}) == Counter(script.kinds)


def test_what_the_cloud_has_enough_of_is_one_message(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    run(start, cloud, script := Script(ack("stored")))
    (packed,) = script.heard
    assert isinstance(packed, PackedReport)
    assert len(packed.encode()) < len(report.encode()) / 10
    assert outbox.counts().acknowledged == 1
    assert outbox.bases_of(REPORT_ID) == {}


def test_the_gaussians_that_are_asked_for_follow_and_no_others(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, tile: Tile
) -> None:
    mask = some(report)
    run(start, cloud, script := Script(ack("wanted", encode_mask(mask)), ack("stored")))
    assert script.kinds == ["PackedReport", "PackedGaussians"]
    second = script.heard[1]
    assert isinstance(second, PackedGaussians)
    expected = report.tiles[0].changed.take(mask)
    assert decode_measured([(tile.tile_id, tile.gaussians, expected.voxel_id)], second.measured) == [expected]
    assert outbox.counts().acknowledged == 1


def test_gaussians_that_reach_a_shard_which_has_not_heard_the_flags_begin_again(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    wanted = encode_mask(some(report))
    run(start, cloud, script := Script(ack("wanted", wanted), ack("resend"), ack("wanted", wanted), ack("stored")))
    assert script.kinds == ["PackedReport", "PackedGaussians"] * 2
    assert outbox.counts().acknowledged == 1


def test_a_report_that_finds_no_shard_twice_goes_whole(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    asked = ack("wanted", encode_mask(some(report)))
    run(start, cloud, script := Script(asked, ack("resend"), asked, ack("resend"), ack("stored")))
    assert script.kinds == ["PackedReport", "PackedGaussians", "PackedReport", "PackedGaussians", "ChangeReport"]
    assert script.heard[-1] == report


@pytest.mark.parametrize(
    "answer",
    [
        ack("resend"),
        ack("quarantined"),
        ack("quarantined", report_id=""),
        Refused("only whole reports here"),
        ack("wanted", b"no mask at all"),
    ],
)
def test_flags_that_are_not_understood_are_followed_by_the_whole_report(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport, answer: ChangeAck | Exception
) -> None:
    run(start, cloud, script := Script(answer, ack("stored")))
    assert script.kinds == ["PackedReport", "ChangeReport"]
    assert script.heard[-1] == report
    assert outbox.counts().acknowledged == 1


def test_refused_gaussians_are_followed_by_the_whole_report_and_only_its_refusal_counts(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    run(
        start, cloud, script := Script(ack("wanted", encode_mask(some(report))), ack("quarantined"), ack("quarantined"))
    )
    assert script.kinds == ["PackedReport", "PackedGaussians", "ChangeReport"]
    assert outbox.refused() == [(REPORT_ID, "a reason")]


def test_bases_damaged_on_the_disk_cost_only_bytes(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    outbox._db.run("UPDATE base SET body = x'00'")
    run(start, cloud, script := Script(ack("wanted", encode_mask(some(report))), ack("stored")))
    assert script.kinds == ["PackedReport", "ChangeReport"]
    assert outbox.counts().acknowledged == 1


def test_a_whole_report_that_is_answered_by_a_question_is_sent_again(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    script = Script(ack("resend"), ack("resend"), ack("stored"))
    cloud.serve(change_keys(), script, workers=1)
    sender = start()
    wait_until(lambda: "was sent whole and answered 'resend'" in sender.last_error)
    assert sender.drain(20.0, NEVER)
    assert script.kinds == ["PackedReport", "ChangeReport", "PackedReport"]


def test_an_agent_killed_between_the_halves_begins_with_the_flags_again(
    start: Opener, outbox: Outbox, cloud: Bus, endpoint: str, report: ChangeReport, tmp_path: Path
) -> None:
    """The first life hears the question and dies while it answers; the second one is asked again."""
    heard, question, first_life = list[Upload](), ack("wanted", encode_mask(some(report))), threading.Event()

    def answer(request: Request) -> bytes:
        heard.append(decode_upload(request.payload))
        if isinstance(heard[-1], PackedReport):
            return question.encode()
        if not first_life.is_set():
            first_life.wait(30.0)
            raise Refused("nobody is there any more")
        return ack("stored").encode()

    cloud.serve(change_keys(), answer, workers=1)
    program = textwrap.dedent(
        f"""
        import threading
        from pathlib import Path
        from fleet_bus.bus import open_bus
        from fleet_bus.config import BusConfig
        from vehicle_agent.outbox import Outbox
        from vehicle_agent.sending import SenderThread
        with open_bus(BusConfig(connect=({endpoint!r},)), name="first") as bus:
            SenderThread(bus, Outbox(Path({str(tmp_path / "outbox.sqlite")!r})))
            threading.Event().wait(60)
        """
    )
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        wait_until(lambda: len(heard) == 2, timeout_s=40.0)
        process.kill()
    first_life.set()
    assert (outbox.counts().pending, len(outbox.bases_of(REPORT_ID))) == (1, 1)
    assert start().drain(30.0, NEVER)
    assert [type(upload).__name__ for upload in heard] == ["PackedReport", "PackedGaussians"] * 2
    assert heard[:2] == heard[2:], "to the bit the same"
    assert outbox.counts().acknowledged == 1


def test_a_report_that_cannot_be_packed_goes_whole_at_once(
    start: Opener, outbox: Outbox, cloud: Bus, report: ChangeReport
) -> None:
    other = dataclasses.replace(report, report_id=deterministic_report_id(1_570_838_400_001, "vehicle", "2"))
    outbox.answered(REPORT_ID, "stored")
    outbox.put(other.report_id, change_key("ndt", report.district), other.encode())
    run(start, cloud, script := Script(ack("stored", report_id=other.report_id)))
    assert script.heard == [other]
