"""Surveys become roads: where drives agree, and where one of them is wrong and must not count."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from survey_street import FRAME, START_NS, Driven, key_of_part, published_map, survey_of_drive

from gnd.cloud_merger.survey.drives import SurveyedDrive, drives_of
from gnd.cloud_merger.survey.inbox import SurveyInbox
from gnd.cloud_merger.survey.mapper import RoadMapper, pieces_of
from gnd.cloud_merger.survey.solve import SolvedPiece, solve_piece
from gnd.gnd_map.codec import codec_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.survey import SurveyReport
from gnd.tile_store import sql_roads
from gnd.tile_store.roads import RoadTile
from gnd.tile_store.sqlite_store import SqliteStore

MAP_END_M = 15.0
FIRST = Driven("car-1", first_m=-20.0, seed=5)
SECOND = Driven("car-2", first_m=-20.0, seed=6, gnss_off_m=(-1.0, 0.7, 0.2), start_ns=START_NS + 10**13)
BACK = Driven(
    "car-3",
    first_m=80.0,
    direction=-1,
    anchored=(4, 5),
    seed=7,
    gnss_off_m=(0.3, 1.2, -1.0),
    start_ns=START_NS + 10**14,
)


@lru_cache
def parts_of(drive: Driven) -> tuple[SurveyReport, ...]:
    return tuple(survey_of_drive(drive))


@lru_cache
def street_map(end_m: float = MAP_END_M, period_m: float | None = None) -> tuple[Tile, ...]:
    return tuple(published_map(-60.0, end_m, period_m))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as opened:
        opened.put_tiles(street_map())
        yield opened


def take(store: SqliteStore, *drives: Driven) -> None:
    inbox = SurveyInbox(store)
    for drive in drives:
        for part in parts_of(drive):
            inbox.keep(key_of_part(part), part, START_NS)


def roads(store: SqliteStore) -> list[RoadTile]:
    return store.look(lambda c: sql_roads.tiles(c, "ndt"))


def states(store: SqliteStore) -> set[str]:
    return {one.state for one in roads(store)}


def solved(*drives: Driven, tiles: Sequence[Tile] = ()) -> SolvedPiece:
    read = drives_of(part for drive in drives for part in parts_of(drive))
    piece = solve_piece(read, {tile.tile_id: tile for tile in tiles or street_map()}, FRAME)
    assert piece is not None
    return piece


def errors_m(piece: SolvedPiece, *drives: Driven) -> np.ndarray:
    """Distances of the submaps from their true places."""
    by_vehicle = {drive.vehicle: drive.true_poses() for drive in drives}
    true = np.concatenate([by_vehicle[one.vehicle] for one in piece.drives])
    return np.linalg.norm(piece.placed.T[:, :3, 3] - true[:, :3, 3], axis=1)


@pytest.mark.slow
def test_one_drive_is_a_draft_two_are_published_and_subscribers_hear_of_it(store: SqliteStore) -> None:
    mapper = RoadMapper(store, "m1")
    take(store, FIRST)
    first = mapper.map_now("ndt")
    assert (first.published, first.versions) == (0, 0)
    assert first.draft > 2
    assert {one.reason for one in roads(store)} == {"1 of 2 vehicles"}
    before = {head.tile: head.version for head in store.heads()}

    take(store, SECOND)
    made = mapper.map_now("ndt")
    assert made.published == made.versions > 2
    good = [one for one in roads(store) if one.state == "published"]
    assert all(one.vehicles == ("car-1", "car-2") and one.sigma_m < 0.12 and one.apart_m < 0.12 for one in good)
    assert all(START_NS <= one.first_ns < one.last_ns <= SECOND.start_ns + 10**11 for one in good)
    noticed = {notice.tile for notice in store.notices()}
    assert {one.tile for one in good} <= noticed
    new = {head.tile: head.version for head in store.heads()}
    assert all(new[one.tile] == before.get(one.tile, 0) + 1 for one in good)
    for one in good:
        head = store.get("ndt", one.tile)
        assert head is not None
        held, added = head.decode_gaussians().gaussians, codec_of(one.codec_id).decode(one.tile, one.body)
        assert len(held) >= len(added) > 0

    again = mapper.map_now("ndt")
    assert again.versions == 0, "the same surveys publish nothing new"


@pytest.mark.slow
def test_a_third_drive_makes_a_published_road_better_until_reports_have_changed_it(store: SqliteStore) -> None:
    mapper = RoadMapper(store, "m1")
    take(store, FIRST, SECOND)
    mapper.map_now("ndt")
    take(store, BACK)
    assert mapper.map_now("ndt").versions > 0
    some = next(one for one in roads(store) if one.state == "published" and len(one.vehicles) == 3)
    head = store.get("ndt", some.tile)
    assert head is not None
    changed = head.decode_gaussians()
    store.put_tiles([Tile(some.tile, 0, changed.gaussians.take(np.arange(len(changed.gaussians) - 5)))])
    other = Driven("car-4", first_m=-20.0, seed=9, start_ns=START_NS + 10**15)
    take(store, other)
    mapper.map_now("ndt")
    now = store.get("ndt", some.tile)
    assert now is not None
    assert now.version == head.version + 1, "what others have published since stays"


def test_three_drives_across_an_edge_are_placed_to_centimetres() -> None:
    piece = solved(FIRST, SECOND, BACK)
    off = errors_m(piece, FIRST, SECOND, BACK)
    assert np.quantile(off, 0.95) < 0.06
    assert not piece.doubts
    sigma = np.sqrt([np.linalg.eigvalsh(c[3:, 3:])[-1] for c in piece.placed.covariance])
    assert np.quantile(off / sigma, 0.95) < 3.5, "what is claimed is what it is"


def test_fixes_five_metres_off_do_not_bend_the_road() -> None:
    biased = Driven("car-2", first_m=-20.0, seed=6, gnss_off_m=(4.0, 3.0, 6.0), start_ns=START_NS + 10**13)
    piece = solved(FIRST, biased, BACK)
    assert np.quantile(errors_m(piece, FIRST, biased, BACK), 0.95) < 0.06
    assert piece.placed.fix_offset_m[1] == pytest.approx(5.0, abs=0.5)
    assert not piece.doubts


def test_drives_that_the_map_has_never_held_stay_drafts_and_say_why(tmp_path: Path) -> None:
    far = [Driven(f"car-{k}", first_m=400.0, seed=20 + k, anchored=(), start_ns=START_NS + k * 10**13) for k in (1, 2)]
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles(street_map())
        take(store, *far)
        made = RoadMapper(store, "m1").map_now("ndt")
        assert (made.published, made.waiting, made.versions) == (0, 0, 0)
        assert made.draft > 2
        assert all("car-1 does not count: the map has never held it" in one.reason for one in roads(store))


def test_a_place_that_looks_like_another_is_not_taken_for_it() -> None:
    """A street that repeats itself every 16 m; one drive has no anchor and its satellites put it 16 m farther on."""
    alike = Driven("car-1", first_m=-20.0, seed=5, period_m=16.0)
    lost = Driven(
        "car-2", first_m=20.0, submaps=4, seed=6, period_m=16.0, anchored=(), gnss_off_m=(16.0, 0.0, 0.0),
        start_ns=START_NS + 10**13,
    )  # fmt: skip
    piece = solved(alike, lost, tiles=street_map(MAP_END_M, 16.0))
    off = errors_m(piece, alike, lost)
    first, second = piece.graph.drive_of == 0, piece.graph.drive_of == 1
    assert off[second].min() > 5.0, "it is wrong ..."
    assert "looks alike" in piece.doubts[1], "... does not count, and it is said why ..."
    assert np.quantile(off[first], 0.95) < 0.1, "... and it bends nobody else"


def test_an_anchor_on_the_wrong_piece_of_wall_is_left_out() -> None:
    """A localiser that is sure of a place 3 m off: the other anchors and the map do not agree, so it does not count."""
    good = parts_of(FIRST)[0]
    T = good.anchors[0].pose.T.copy()
    T[0, 3] += 3.0
    wrong = replace(good.anchors[0], pose=replace(good.anchors[0].pose, T=T))
    forged = replace(good, anchors=(*good.anchors, wrong))
    read = drives_of([forged, *parts_of(SECOND), *parts_of(BACK)])
    piece = solve_piece(read, {tile.tile_id: tile for tile in street_map()}, FRAME)
    assert piece is not None
    assert piece.left_out["anchor"] >= 1
    assert np.quantile(errors_m(piece, FIRST, SECOND, BACK), 0.95) < 0.1


def test_a_vehicle_that_sees_walls_elsewhere_is_not_agreed_with(store: SqliteStore) -> None:
    bent = Driven("car-2", first_m=-20.0, seed=6, bent_m=1.5, start_ns=START_NS + 10**13)
    take(store, FIRST, bent)
    made = RoadMapper(store, "m1").map_now("ndt")
    far = [one for one in roads(store) if one.state == "published"]
    wrong = [one for one in roads(store) if one.state != "published"]
    assert made.waiting > 0
    assert all(
        "apart" in one.reason or "shared" in one.reason or "known to" in one.reason or "vehicles" in one.reason
        for one in wrong
    )
    assert all(one.apart_m is not None and one.apart_m <= 0.12 for one in far)


def test_one_vehicle_that_drives_twice_is_still_one(store: SqliteStore) -> None:
    again = Driven("car-1", first_m=-20.0, seed=6, start_ns=START_NS + 10**13)
    take(store, FIRST, again)
    made = RoadMapper(store, "m1").map_now("ndt")
    assert made.published == 0
    assert {one.state for one in roads(store)} == {"draft"}
    assert {one.drives for one in roads(store)} >= {2}


def test_parts_may_come_twice_and_in_any_order_and_a_missing_one_breaks_the_chain() -> None:
    pieces = Driven("car-1", first_m=-20.0, seed=5, parts=((0, 1), (2, 3), (4, 5)))
    first, second, third = parts_of(pieces)
    (whole,) = drives_of([third, first, second, second])
    assert [node.number for node in whole.nodes] == list(range(6))
    assert [len(drive) for drive in drives_of([third, first])] == [2, 2]
    (start, rest) = drives_of([first, third])
    assert rest.nodes[0].step is None
    assert start.nodes[1].step is not None


def test_drives_that_never_meet_are_pieces_of_their_own() -> None:
    far = Driven("car-9", first_m=4000.0, submaps=3, seed=8, anchored=())
    drives = drives_of([*parts_of(FIRST), *parts_of(far), *parts_of(BACK)])
    assert sorted(len(piece) for piece in pieces_of(drives)) == [1, 2]


def test_a_piece_that_fails_does_not_stop_the_others(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    take(store, FIRST, Driven("car-9", first_m=4000.0, submaps=3, seed=8, anchored=()))

    def failing(drives: Sequence[SurveyedDrive], tiles: Mapping[TileId, Tile], frame: LocalFrame) -> SolvedPiece | None:
        if drives[0].vehicle == "car-9":
            raise RuntimeError("Indeterminant linear system")
        return solve_piece(drives, tiles, frame)

    monkeypatch.setattr("gnd.cloud_merger.survey.solve.solve_piece", failing)
    made = RoadMapper(store, "m1").map_now("ndt")
    assert (made.pieces, made.failed) == (2, 1)
    assert made.draft > 2


def test_only_one_shard_maps_a_layer_and_what_it_has_done_is_not_done_again(store: SqliteStore) -> None:
    take(store, FIRST)
    later = START_NS + 60 * 10**9
    mapper = RoadMapper(store, "m1", now_ns=lambda: later)
    assert store.transact(lambda c, _: sql_roads.lease(c, "ndt", "other", 60.0))
    assert mapper.work() == 0
    store.transact(lambda c, _: sql_roads.settle(c, "ndt", "other", None))
    assert mapper.work() == 1
    assert mapper.work() == 0
    assert states(store) == {"draft"}
    assert RoadMapper(store, "m2", now_ns=lambda: START_NS).work() == 0
