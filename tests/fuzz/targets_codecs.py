"""Targets: codecs of tiles, deltas, flags, tracks, features, and what the cloud remembers."""

import struct
import zlib
from binascii import crc_hqx
from functools import cache
from random import Random

import numpy as np
import zstandard
from codec_fuzzing import TILE, decoders, flagged, resealed, states
from feature_values import feature_report
from fuzz_mutators import bytes_mutated, repaired, text_mutated
from fuzz_target import FuzzTarget

from gnd.cloud_merger.features.memory import LayerMemory, Own, PlaceEstimate, Remembered, Vote
from gnd.cloud_merger.memory import PARKED, STATEMENT, VOXEL, TileMemory, Witness
from gnd.gnd_map.bounded import inflated, zstd_unpacked
from gnd.gnd_map.codec import (
    REPORT,
    Flags,
    decode_delta,
    decode_flags,
    decode_measured,
    encode_delta,
    encode_flags,
    encode_measured,
    snap,
)
from gnd.gnd_map.content import decode_content
from gnd.gnd_map.features.feature_codec import decode_features, encode_features
from gnd.gnd_map.features.feature_tile import decode_feature_delta, encode_feature_delta
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, TrackPiece, TrackView, decode_track, encode_track
from gnd.tile_store.provenance import Provenance, decode_provenance, encode_provenance

_READS = {
    "tiles": "gnd_map/codec/patch.py:decode_tiles",
    "mask": "gnd_map/codec/patch.py:decode_mask",
    "float32 columns": "gnd_map/codec/floats.py:decode_gaussians",
    "float32 columns, Zstandard": "gnd_map/codec/zstd_columns.py:decode_float_columns",
    "standard, columns, Zstandard": "gnd_map/codec/zstd_columns.py:decode_lattice_columns",
    "standard, range coded": "gnd_map/codec/range_tile.py:decode_tile",
    "standard, range coded by sets": "gnd_map/codec/range_tile.py:decode_tile_by_set",
    "standard, by sums": "gnd_map/codec/rans_tile.py:decode_tile_by_sums",
}


def _codec_targets() -> list[FuzzTarget]:
    found = {one.name: one for one in decoders()}
    plain = [one for name, one in found.items() if name not in ("delta", "flags", "measured")]
    return [
        FuzzTarget(
            f"codec-{one.name.replace(', ', '-').replace(' ', '-').lower()}",
            (_READS[one.name],) if one.name in _READS else (),
            f"encoded Gaussians: {one.name}",
            one.decode,
            lambda one=one: list(one.messages),  # type: ignore[misc]
            repaired(bytes_mutated, one.repaired),
            rounds=120,
        )
        for one in plain
    ]


_STATES = tuple(snap(state, REPORT) for state in states())
_OTHER = TileId(TILE.morton + 4)


def _base(data: bytes) -> Gaussians:
    """The first byte of an input says which base its message meets."""
    return _STATES[(data[0] if data else 0) % len(_STATES)]


def _delta(data: bytes) -> object:
    return decode_delta(TILE, _base(data), data[1:])


def _flags(data: bytes) -> object:
    return decode_flags([(TILE, _base(data)), (_OTHER, _STATES[1])], data[1:])


def _measured(data: bytes) -> object:
    return decode_measured([(TILE, _base(data), _STATES[2].voxel_id)], data[1:])


def _deltas() -> list[bytes]:
    pairs = [(k, after) for k in range(len(_STATES)) for after in _STATES if after is not _STATES[k]]
    return [bytes([k]) + encode_delta(TILE, _STATES[k], after) for k, after in pairs]


def _flag_messages() -> list[bytes]:
    rng, messages = np.random.default_rng(6), []
    for k, base in enumerate(_STATES):
        flags = [Flags(tile, b, *flagged(b, tile, rng)) for tile, b in ((TILE, base), (_OTHER, _STATES[1]))]
        messages.append(bytes([k]) + encode_flags(flags))
    return messages


def _measured_messages() -> list[bytes]:
    return [bytes([k]) + encode_measured([(TILE, base, _STATES[2])]) for k, base in enumerate(_STATES)]


def _sealed(data: bytes) -> bytes:
    return data[:1] + resealed(data[1:])


def _sealed_delta(data: bytes) -> bytes:
    """A delta begins with the number of its lattice, outside of its checksum."""
    return data[:2] + resealed(data[2:])


def _crc32_right(data: bytes) -> bytes:
    return data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "little")


def _track_right(data: bytes) -> bytes:
    return data[:-2] + struct.pack("<H", crc_hqx(data[:-2], 0))


_FEATURES = tuple(one.as_feature(k + 1) for k, one in enumerate(feature_report().snapped().tiles[0].found))


def _tracks() -> list[bytes]:
    district = TILE.district
    vertices = np.array([[100, 200, 300], [110, 220, 301], [140, 260, 299]], np.int32)
    view = TrackView((-60, -40, -20, -10, 0, 5, 10, 20, 40))
    return [encode_track(Track(district, view, (TrackPiece(vertices, 7), TrackPiece(vertices + 50, 3))))]


def _zstd_text(data: bytes, rng: Random) -> bytes:
    """The text under Zstandard changes; sometimes its own frame does, or it is a bomb."""
    kind = rng.randrange(12)
    if kind == 0:
        return bytes_mutated(data, rng)
    if kind == 1:
        return _zstd_bomb() if rng.randrange(50) == 0 else b""
    try:
        plain = zstd_unpacked(data, 1 << 20)
    except ValueError:
        return bytes_mutated(data, rng)
    return zstandard.ZstdCompressor(level=1).compress(text_mutated(plain, rng))


@cache
def _zstd_bomb() -> bytes:
    return zstandard.ZstdCompressor().compress(bytes(1 << 28))


@cache
def _zlib_bomb() -> bytes:
    return zlib.compress(b" " * (1 << 28), 1)


def _zlib_text(data: bytes, rng: Random) -> bytes:
    try:
        plain = inflated(data, 1 << 20)
    except ValueError:
        return bytes_mutated(data, rng)
    if rng.randrange(400) == 0:
        return _zlib_bomb()
    return zlib.compress(text_mutated(plain, rng), 1) if rng.randrange(8) else bytes_mutated(data, rng)


_REPORT_ID = "01HF0000000000000000000000"


def _memories() -> list[bytes]:
    voxels = np.zeros(3, VOXEL)
    voxels["voxel_id"], voxels["observers"] = [3, 5, 9], 2
    claims, parked = np.zeros(2, STATEMENT), np.zeros(1, PARKED)
    claims["voxel_id"], parked["voxel_id"] = [3, 5], 9
    witness = Witness(
        "01HF0000000000000000000000",
        "car-1",
        1_700_000_000_000_000_000,
        1_700_000_001_000_000_000,
        1_700_000_002_000_000_000,
        False,
        0.01,
    )
    memory = TileMemory(voxels, claims, (witness,), {"car-1": 5}, parked)
    return [TileMemory().encode(), memory.encode()]


def _layer_memories() -> list[bytes]:
    place = PlaceEstimate(np.array([[4.0, -7.0, 31.0]]), np.eye(3) * 0.04)
    one = _FEATURES[0]
    track = Remembered(
        5, one.kind, (one.kind,), place, one, one, None, is_published=True, is_settled=True, is_away=False,
        votes=((0, Vote("car-1", one.existence, 2, "")),), known=place,
        measured=(Own("car-1", 2, place, (), False, 0),),
        vehicles_before=1, ayes_before=1, hits_before=2, apart=frozenset(), day=9000,
    )  # fmt: skip
    return [LayerMemory().encode(), LayerMemory((track,), (_REPORT_ID,)).encode()]


def _feature_delta(data: bytes) -> object:
    return decode_feature_delta(_FEATURES, data)


def _content(data: bytes) -> object:
    return decode_content(TileId(TILE.morton), 1, data[0] % 64 if data else 0, data[1:])


def _contents() -> list[bytes]:
    bodies = [bytes([number]) + one.messages[2] for number, one in enumerate(decoders()[:11])]
    return [*bodies, bytes([32]) + encode_features(_FEATURES)]


TARGETS = (
    *_codec_targets(),
    FuzzTarget("codec-delta", ("gnd_map/codec/patch.py:decode_delta",), "delta of Gaussians after the number of a base",
               _delta, _deltas, repaired(bytes_mutated, _sealed_delta), rounds=120),
    FuzzTarget("codec-flags", ("gnd_map/codec/patch.py:decode_flags",), "flags of a report after the number of a base",
               _flags, _flag_messages, repaired(bytes_mutated, _sealed), rounds=120),
    FuzzTarget("codec-measured", ("gnd_map/codec/patch.py:decode_measured",),
               "measured Gaussians after the number of a base", _measured, _measured_messages,
               repaired(bytes_mutated, _sealed), rounds=120),
    FuzzTarget("content", ("gnd_map/content.py:decode_content",), "a body under its codec's number", _content,
               _contents, bytes_mutated),
    FuzzTarget("features", ("gnd_map/features/feature_codec.py:decode_features",), "codec 32: features of a tile",
               decode_features, lambda: [encode_features(_FEATURES), encode_features(())],
               repaired(bytes_mutated, _crc32_right)),
    FuzzTarget("feature-delta", ("gnd_map/features/feature_tile.py:decode_feature_delta",
                                 "gnd_map/features/feature_tile.py:read_feature_delta",
                                 "gnd_map/content.py:decode_content_delta"),
               "delta of features", _feature_delta,
               lambda: [encode_feature_delta(_FEATURES, _FEATURES[:-1]), encode_feature_delta((), _FEATURES)],
               repaired(bytes_mutated, _crc32_right)),
    FuzzTarget("track", ("gnd_map/track.py:decode_track",), "track of a report",
               lambda data: decode_track(TILE.district, data), _tracks, repaired(bytes_mutated, _track_right)),
    FuzzTarget("tile-memory", ("cloud_merger/memory.py:TileMemory.decode",), "what a merged tile remembers",
               TileMemory.decode, _memories, _zstd_text),
    FuzzTarget("layer-memory", ("cloud_merger/features/memory.py:LayerMemory.decode",),
               "what a merged feature layer remembers", LayerMemory.decode, _layer_memories, _zstd_text),
    FuzzTarget("provenance", ("tile_store/provenance.py:decode_provenance",), "reports behind a version",
               decode_provenance, lambda: [encode_provenance(Provenance(("a", "b"), {3: (0,), 7: (0, 1)}))],
               _zlib_text),
)  # fmt: skip
