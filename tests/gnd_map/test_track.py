"""Tracks: what goes in comes out, in few bytes; damage and claims are refused; builders keep what matters."""

import struct
from binascii import crc_hqx
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.errors import CodecError, TrackError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import LON_TILES, District, TileId
from gnd.gnd_map.track import MAX_TRACK_BYTES, Track, TrackPiece, TrackView, decode_track, encode_track
from gnd.gnd_map.track_builder import TrackBuilder

DISTRICT = TileId(497353963154).district
LEVELS = (-60, -52, -36, -20, -4, 12, 28, 44, 60)
GOLDEN = "c4ccdcecfc0c1c2c3cffff3b32028a030380058010b8019001001f0010000101f00300000505"


def view(**changes):
    return TrackView(**{"levels": LEVELS, "rays_log2": 59, "range_m": 50, **changes})


def track_of(*pieces, district=DISTRICT):
    return Track(district, view(), tuple(TrackPiece(np.array(v, np.int32).reshape(-1, 3), n) for v, n in pieces))


ROAD = track_of(([(320, 1024, 92), (392, 1024, 76), (392, 1032, 76)], 394), ([(640, 1032, 76)], 1))

vertices = st.lists(
    st.tuples(st.integers(-1024, 3072), st.integers(-1024, 3072), st.integers(-2000, 20000)), min_size=1, max_size=20
)
views = st.builds(
    TrackView,
    levels=st.lists(st.integers(-128, 127), min_size=9, max_size=9).map(lambda x: tuple(sorted(x))),
    sectors=st.integers(1, 0xFFFF),
    rays_log2=st.integers(0, 96),
    range_m=st.integers(1, 255),
)


@given(views, st.lists(st.tuples(vertices, st.integers(1, 1_000_000)), max_size=6))
def test_what_goes_in_comes_out(seen, pieces):
    track = Track(DISTRICT, seen, tuple(TrackPiece(np.array(v, np.int32).reshape(-1, 3), n) for v, n in pieces))
    assert decode_track(DISTRICT, encode_track(track)) == track


def test_the_bytes_stay_what_they_are():
    assert encode_track(ROAD).hex() == GOLDEN
    assert decode_track(DISTRICT, bytes.fromhex(GOLDEN)) == ROAD
    assert ROAD.scans == 395


@settings(max_examples=300)
@given(st.binary(max_size=80))
def test_whatever_is_no_track_is_refused(data):
    with pytest.raises(CodecError):
        decode_track(DISTRICT, data)


@settings(max_examples=500)
@given(st.integers(0, len(GOLDEN) * 4 - 1), st.integers(0, 60))
def test_flipped_bits_and_lost_ends_are_refused(bit, lost):
    data = bytearray.fromhex(GOLDEN)
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(CodecError):
        decode_track(DISTRICT, bytes(data))
    with pytest.raises(CodecError):
        decode_track(DISTRICT, bytes.fromhex(GOLDEN)[: -1 - lost])


def forged(body):
    """A body with the right checksum behind it."""
    head = bytes.fromhex(GOLDEN)[:13]
    return head + body + struct.pack("<H", crc_hqx(head + body, 0))


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"\xff\xff\xff\x7f", "claims 268435455 pieces, the limit is 256"),
        (b"\x01\x01\xff\xff\xff\x7f", "claims 268435455 vertices, the limit is 4096"),
        (b"\xff\xff\xff\xff\x01", "a number of more than 4 bytes"),
        (b"\x01\x01\x02\x00\x00\x00", "ends before its last vertex"),
        (b"\x01\x01\x01\x00\x00\x80", "ends in the middle of a number"),
        (b"\x00\x00", "bytes behind its last vertex"),
        (b"\x01\x00\x01\x00\x00\x00", "1 vertices, 0 scans"),
        (b"\x01\x01\x00", "0 vertices, 1 scans"),
        (b"\x01\x01\x01\xff\xff\xff\x7f\x00\x00", "lie outside"),
    ],
)
def test_claims_with_a_right_checksum_are_refused_with_numbers(body, said):
    with pytest.raises(CodecError, match=said):
        decode_track(DISTRICT, forged(body))


def test_too_much_is_refused():
    with pytest.raises(CodecError, match=f"of {MAX_TRACK_BYTES + 1} bytes"):
        decode_track(DISTRICT, bytes(MAX_TRACK_BYTES + 1))
    zigzag = [(3000 * (k % 2), 3000 * (k % 2), 0) for k in range(4096)]
    with pytest.raises(TrackError, match="the limit is 16384"):
        encode_track(track_of((zigzag, 1)))
    with pytest.raises(TrackError, match="4097 vertices"):
        track_of((zigzag, 1), ([(0, 0, 0)], 1))


@pytest.mark.parametrize(
    "changes",
    [
        {"levels": LEVELS[:-1]},
        {"levels": LEVELS[::-1]},
        {"levels": (-129, *LEVELS[1:])},
        {"sectors": 0},
        {"sectors": 1 << 16},
        {"range_m": 0},
        {"rays_log2": 97},
    ],
)
def test_views_that_no_sensor_has_are_refused(changes):
    with pytest.raises(TrackError):
        view(**changes)


# --- building


FRAME = LocalFrame(np.radians(37.56), np.radians(127.04), 40.0)
ELEVATIONS = np.radians(np.arange(-15, 16, 2))


def hits(origin, yaw_rad, half_span_rad=np.pi):
    """What a sensor with 16 layers sees in a hall of 20 m, turned by `yaw_rad`."""
    azimuth = np.linspace(-half_span_rad, half_span_rad, 181)[:-1] + yaw_rad
    a, e = np.meshgrid(azimuth, ELEVATIONS)
    return origin + 20.0 * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)


def pose(yaw_rad):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    return T


def driven(positions, yaw_rad=0.5, half_span_rad=np.pi):
    builder = TrackBuilder(FRAME)
    for k, p in enumerate(np.asarray(positions, float)):
        builder.add_scan(k, hits(p, yaw_rad, half_span_rad), p, pose(yaw_rad))
    return builder


def tiles_at(*points):
    lat, lon, _ = FRAME.geodetic_from_enu(np.array(points, float))
    return [TileId.from_geodetic(a, b) for a, b in zip(lat.tolist(), lon.tolist(), strict=True)]


STRAIGHT = [(x, 0.3 * np.sin(x), 1.9) for x in np.arange(0.0, 60.0)]


def test_a_straight_road_is_two_vertices_at_the_right_place():
    tiles = tiles_at((30.0, 0.0, 0.0))
    track = driven(STRAIGHT).track(tiles[0].district, tiles)
    (piece,) = track.pieces
    assert (len(piece.vertices), piece.scans) == (2, 60)
    u, v, height = track.tile_coordinates(piece)[0]
    lat, lon, h = FRAME.geodetic_from_enu(np.array([STRAIGHT[0]]))
    assert abs(u - (lon[0] / (2 * np.pi) + 0.5) * LON_TILES) <= 0.5 / 64
    assert abs(v - (lat[0] / (2 * np.pi) + 0.25) * LON_TILES) <= 0.5 / 64
    assert abs(height - h[0]) <= 0.25
    assert len(encode_track(track)) < 40


def test_a_bend_stays_within_the_tolerance():
    angle = np.linspace(0.0, np.pi / 2, 80)
    bend = np.stack([30 * np.sin(angle), 30 * (1 - np.cos(angle)), np.full(80, 1.9)], axis=1)
    tiles = tiles_at((15.0, 5.0, 0.0))
    track = driven(bend).track(tiles[0].district, tiles)
    (piece,) = track.pieces
    assert 4 <= len(piece.vertices) <= 12
    uvh = track.tile_coordinates(piece)
    lat, lon = (uvh[:, 1] / LON_TILES - 0.25) * 2 * np.pi, (uvh[:, 0] / LON_TILES - 0.5) * 2 * np.pi
    line = FRAME.enu_from_geodetic(lat, lon, uvh[:, 2])
    along = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(line)])
    off = np.linalg.norm(bend[:, None, :2] - along[None, :, :2], axis=2).min(axis=1)
    assert off.max() < 1.0  # the tolerance and the rounding of vertices


def test_scans_that_did_not_count_part_the_track():
    builder = driven([p for p in STRAIGHT if not 20 <= p[0] < 30])
    tiles = tiles_at((30.0, 0.0, 0.0))
    assert [piece.scans for piece in builder.track(tiles[0].district, tiles).pieces] == [20, 30]


def test_only_scans_near_the_tiles_and_late_enough_belong_to_the_track():
    far = [(x, 0.0, 1.9) for x in np.arange(0.0, 400.0)]
    builder, tiles = driven(far), tiles_at((200.0, 0.0, 0.0))
    track = builder.track(tiles[0].district, tiles)
    assert 120 <= track.scans <= 165  # 60 m on either side of a tile of 30 m
    late = builder.track(tiles[0].district, tiles, since_ns=200)
    assert late.scans < track.scans
    builder.forget_before(200)
    assert len(builder) == 200
    assert builder.track(tiles[0].district, tiles) == late
    with pytest.raises(TrackError, match="none of 200 scans"):
        builder.track(tiles[0].district, tiles_at((0.0, 3000.0, 0.0)))
    with pytest.raises(TrackError, match="none of 0 scans"):
        TrackBuilder(FRAME).track(tiles[0].district, tiles)


def test_the_view_is_the_sensors_own_whatever_the_heading():
    tiles = tiles_at((30.0, 0.0, 0.0))
    seen = driven(STRAIGHT).track(tiles[0].district, tiles).view
    assert (seen.levels[0], seen.levels[-1]) == (-60, 60)
    assert seen.sectors == 0xFFFF
    assert 20 <= seen.range_m <= 21
    assert abs(seen.rays / (180 * 16) - 1) < 0.1
    ahead = driven(STRAIGHT, half_span_rad=np.pi / 4).track(tiles[0].district, tiles).view
    assert ahead.sectors == 0b1100000000000011


def test_a_vehicle_that_stands_is_one_vertex_and_a_scan_without_points_none():
    builder, tiles = driven([(0.0, 0.0, 1.9)] * 5), tiles_at((0.0, 0.0, 0.0))
    builder.add_scan(9, np.zeros((0, 3)), np.zeros(3), np.eye(4))
    (piece,) = builder.track(tiles[0].district, tiles).pieces
    assert (len(piece.vertices), piece.scans) == (1, 5)


def test_a_track_may_lie_west_of_the_date_line_and_its_district_east_of_it():
    frame = LocalFrame(np.radians(52.0), np.radians(180.0), 0.0)
    builder = TrackBuilder(frame)
    for k in range(20):
        p = np.array([k - 15.0, 0.0, 2.0])
        builder.add_scan(k, hits(p, 0.0), p, np.eye(4))
    tile = TileId.from_geodetic(frame.lat_rad, np.radians(-179.9999))
    assert tile.lon_index == 0
    track = builder.track(tile.district, [tile])
    assert track.scans == 20
    assert track.pieces[0].vertices[0, 0] < 0 < track.pieces[0].vertices[-1, 0]
    assert isinstance(track.district, District)
