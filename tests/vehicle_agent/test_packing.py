"""Packing is pure: the same bytes each time; what flags cannot say is an error, not a loss."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import GRID_FRAME, SENSOR, ground, look, tiles_of, wall

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, REPORT, decode_flags, decode_measured, encode_mask, is_on, snap
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import decode_track
from gnd.schemas.changes import ChangeReport
from gnd.schemas.course import Course
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.schemas.packed import PackedReport, decode_upload, digest_of
from gnd.schemas.upload_head import head_of_upload
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.errors import AgentConfigError, PackingError
from gnd.vehicle_agent.link.outbox import Letter, Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.pipeline import known_course
from gnd.vehicle_agent.report.packing import AT_ONCE_BYTES, Bases, askable, asked_for, is_measured, pack, pack_measured
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.segment import SegmentedScan

START_NS = 1_570_838_400_000_000_000


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    found = tiles_of(np.concatenate([ground(), wall(9.3)]))
    return {t: Tile(t, 1, snap(tile.gaussians, LATTICES["standard"])) for t, tile in found.items()}


def drive(
    folder: Path,
    tiles: dict[TileId, Tile],
    protocol: str = "packed",
    course: Callable[[], Course | None] = lambda: None,
) -> Outbox:
    """Three scans from one place; where the map has a wall at 9.3 m, there is one at 14.3 m."""
    local_map, outbox = LocalMap(GRID_FRAME), Outbox(folder / "outbox.sqlite")
    for tile in tiles.values():
        local_map.set_tile(tile)
    who = Identity("vehicle-7", "drive-7", "VLP-16", "ndt", software="test 1")
    parameters = ReportParameters(protocol=protocol)  # type: ignore[arg-type]
    reporter = Reporter(ChangeDetector(local_map), outbox, who, START_NS, parameters, course)
    hits = look([(14.3, -8.0, 8.0, 4.0)], np.random.default_rng(3))
    T = np.eye(4)
    T[:3, 3] = SENSOR
    for number in range(3):
        pose = PoseEstimate(START_NS + number * 10**8, T, 0.03, 0.001, 0.9, "good")
        scan = RefinedScan(pose.t_ns, PlacedRays(hits, np.broadcast_to(SENSOR, hits.shape)), pose)
        reporter.add_scan(SegmentedScan(scan, np.zeros(len(hits), np.bool_)))
    reporter.report_all(20.0)
    assert reporter.counts["reports_not_packed"] == 0
    return outbox


@pytest.fixture(scope="module")
def letter(tmp_path_factory: pytest.TempPathFactory, tiles: dict[TileId, Tile]) -> Letter:
    (found,) = drive(tmp_path_factory.mktemp("drive"), tiles).due(0)
    return found


@pytest.fixture(scope="module")
def report(letter: Letter) -> ChangeReport:
    return ChangeReport.decode(letter.body)


@pytest.fixture(scope="module")
def bases(tiles: dict[TileId, Tile]) -> Bases:
    return {tile.sha: tile.gaussians for tile in tiles.values()}


def test_a_reporter_puts_the_short_form_beside_the_whole_one(
    letter: Letter, report: ChangeReport, tiles: dict[TileId, Tile]
) -> None:
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    assert (packed.report_id, packed.vehicle, packed.software) == (letter.report_id, "vehicle-7", "test 1")
    assert (packed.first_ns, packed.last_ns) == (report.first_ns, report.last_ns)
    assert [TileId(report.district.first_morton + index) for index, _ in packed.tiles] == [c.tile for c in report.tiles]
    assert {version for _, version in packed.tiles} == {1}
    assert packed.base_digest == digest_of(change.base_sha for change in report.tiles)
    flags = decode_flags([(c.tile, tiles[c.tile].gaussians) for c in report.tiles], packed.flags)
    for one, change in zip(flags, report.tiles, strict=True):
        assert one.voxel_id.tolist() == change.changed.voxel_id.tolist()
        assert one.change_class.tolist() == change.change_class.tolist()
    assert decode_track(report.district, packed.track).scans == 3
    assert 0 <= packed.pose_sigma_m - max(c.pose_sigma_m for c in report.tiles) <= 1e-4
    assert 0 <= packed.pose_sigma_rad - max(c.pose_sigma_rad for c in report.tiles) <= 1e-5
    assert len(letter.packed) < len(letter.body) / 10


def test_a_few_gaussians_come_with_the_flags_and_many_wait_to_be_asked_for(
    report: ChangeReport, bases: Bases, letter: Letter
) -> None:
    track = decode_track(report.district, PackedReport.decode(letter.packed).track)
    every = pack_measured(report, bases, encode_mask(np.ones(askable(report), np.bool_))).measured
    assert PackedReport.decode(letter.packed).measured == (every if len(every) <= AT_ONCE_BYTES else b"")
    for most_bytes, measured in ((0, b""), (len(every) - 1, b""), (len(every), every)):
        assert pack(report, bases, track, most_bytes).measured == measured


@pytest.mark.parametrize(
    ("is_last", "most_bytes", "is_patient"), [(False, 0, False), (False, 10_000, True), (True, 10_000, False)]
)
def test_only_who_sends_more_and_has_nothing_to_be_asked_for_is_patient(
    report: ChangeReport, bases: Bases, letter: Letter, is_last: bool, most_bytes: int, is_patient: bool
) -> None:
    track = decode_track(report.district, PackedReport.decode(letter.packed).track)
    packed = pack(report, bases, track, most_bytes, is_last=is_last)
    assert packed.is_patient == head_of_upload(packed.encode()).is_patient == is_patient
    assert not PackedReport.decode(letter.packed).is_patient, "the drive had ended"


def test_every_gaussian_that_a_report_holds_can_travel_in_short(report: ChangeReport) -> None:
    found = [change.changed.take(is_measured(change)) for change in report.tiles]
    assert sum(map(len, found)) == askable(report) > 20
    assert all(is_on(gaussians, REPORT) for gaussians in found)


def test_the_outbox_has_what_the_second_half_needs(
    tmp_path: Path, tiles: dict[TileId, Tile], report: ChangeReport, bases: Bases
) -> None:
    outbox, wanted = drive(tmp_path, tiles), encode_mask(np.ones(askable(report), np.bool_))
    kept = outbox.bases_of(report.report_id)
    assert kept.keys() == {c.base_sha for c in report.tiles if is_measured(c).any()}
    assert pack_measured(report, kept, wanted) == pack_measured(report, bases, wanted)


def test_a_restarted_reporter_packs_the_same_bytes(tmp_path: Path, tiles: dict[TileId, Tile], letter: Letter) -> None:
    assert drive(tmp_path, tiles).due(0) == [letter]


def test_whole_reports_on_demand(tmp_path: Path, tiles: dict[TileId, Tile], letter: Letter) -> None:
    (whole,) = (outbox := drive(tmp_path, tiles, "full")).due(0)
    assert (whole.body, whole.packed) == (letter.body, b"")
    assert outbox.bases_of(whole.report_id) == {}


def test_an_unknown_protocol_is_refused() -> None:
    with pytest.raises(AgentConfigError, match="'morse'"):
        ReportParameters(protocol="morse")  # type: ignore[arg-type]


def test_the_second_half_holds_the_wanted_gaussians_tile_by_tile(report: ChangeReport, bases: Bases) -> None:
    mask = np.random.default_rng(5).random(askable(report)) < 0.5
    entries = asked_for(report, bases, mask)
    assert sum(len(measured) for _, _, measured in entries) == mask.sum() > 5
    half = pack_measured(report, bases, encode_mask(mask))
    asked = [(tile, base, measured.voxel_id) for tile, base, measured in entries]
    assert decode_measured(asked, half.measured) == [measured for _, _, measured in entries]


def test_a_missing_base_is_named(report: ChangeReport, letter: Letter) -> None:
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    with pytest.raises(PackingError, match="is not among 0 bases"):
        pack(report, {}, decode_track(report.district, packed.track))
    first = next(change.tile for change in report.tiles if is_measured(change).any())
    with pytest.raises(PackingError, match=f"tile {first}: its base"):
        asked_for(report, {}, np.ones(askable(report), np.bool_))


def test_classes_that_flags_cannot_say_are_refused(report: ChangeReport, bases: Bases, letter: Letter) -> None:
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    track = decode_track(report.district, packed.track)
    at = next(k for k, change in enumerate(report.tiles) if len(change.changed))
    for kind in (ChangeClass.NORMAL, ChangeClass.EMPTY):
        odd = dataclasses.replace(report.tiles[at], change_class=np.full_like(report.tiles[at].change_class, kind))
        tiles = (*report.tiles[:at], odd, *report.tiles[at + 1 :])
        with pytest.raises(PackingError, match=f"changed voxels of classes .*{int(kind)}"):
            pack(dataclasses.replace(report, tiles=tiles), bases, track)


def test_a_class_that_contradicts_the_base_is_refused(report: ChangeReport, bases: Bases, letter: Letter) -> None:
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    empty = dict.fromkeys(bases, Gaussians.empty())
    with pytest.raises(GndError, match="are new but held, or changed but not held"):
        pack(report, empty, decode_track(report.district, packed.track))


def test_doubts_travel_in_short_by_their_tiles(report: ChangeReport, bases: Bases, letter: Letter) -> None:
    packed, doubt = decode_upload(letter.packed), Doubt(DoubtReason.IMPLAUSIBLE_SHARE, changed_permille=700)
    assert isinstance(packed, PackedReport)
    track = decode_track(report.district, packed.track)
    sure = [dataclasses.replace(change, doubt=None) for change in report.tiles[:-1]]
    last = dataclasses.replace(report.tiles[-1], doubt=doubt)
    found = pack(dataclasses.replace(report, tiles=(*sure, last)), bases, track, AT_ONCE_BYTES)
    assert found == dataclasses.replace(packed, doubts=((packed.tiles[-1][0], doubt),))
    assert PackedReport.decode(found.encode()) == found


def test_changes_held_back_do_not_travel_in_short(report: ChangeReport, bases: Bases, letter: Letter) -> None:
    """The cloud would take what the track reaches for observed and unchanged."""
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    first = report.tiles[0]
    silent = dataclasses.replace(
        first,
        observed=np.empty(0, np.int32),
        changed=Gaussians.empty(),
        change_class=np.empty(0, np.uint8),
        evidence=np.empty((0, 4), np.int32),
        doubt=Doubt(DoubtReason.EXPLAINED_BY_SHIFT, withheld=5),
    )
    said = dataclasses.replace(report, tiles=(silent, *report.tiles[1:]))
    with pytest.raises(PackingError, match="holds changes back"):
        pack(said, bases, decode_track(report.district, packed.track))


def test_the_course_of_the_vehicle_goes_with_both_forms(tmp_path: Path, tiles: dict[TileId, Tile]) -> None:
    (letter,) = drive(tmp_path, tiles, course=lambda: Course.of(0.0087, 2e-4)).due(0)
    assert ChangeReport.decode(letter.body).course == Course(870, 20)
    packed = decode_upload(letter.packed)
    assert isinstance(packed, PackedReport)
    assert packed.course == Course(870, 20)


def test_a_course_that_is_not_known_well_is_not_told() -> None:
    known = MotionTeacher(MotionBuffer()).calibration
    assert known_course(known) is None
    assert known_course(dataclasses.replace(known, course_rad=0.0087, course_sigma_rad=2e-4)) == Course(870, 20)
    assert known_course(dataclasses.replace(known, course_rad=0.0087, course_sigma_rad=2.1e-3)) is None
