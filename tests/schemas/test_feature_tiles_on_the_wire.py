"""Tiles of feature layers in the messages that carry tiles: frozen bytes, and damage that is a SchemaError only."""

import contextlib
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from schema_values import SHA, TILE
from test_schema_fuzz import mutated

from gnd.gnd_map.content import encode_content, encode_content_delta
from gnd.gnd_map.features import Existence, Feature, FeatureTile
from gnd.schemas.errors import BadValue, SchemaError, WrongHash
from gnd.schemas.tile_answer import content_of_answer
from gnd.schemas.tiles import CodedDelta, TileBlob, TileReply, TileRequest, content_of, tile_after
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest
from gnd.schemas.updates import TileUpdate, updated

GOLDEN_DIR = Path(__file__).parent / "golden_feature_tiles"
COV_M2 = np.array([0.04, 0.01, 0.0, 0.09, 0.0, 1e4])


def sign(number: int, x_m: float = 4.25, **values: Any) -> Feature:
    points_m = np.array([[x_m, -7.5, 31.062]])
    return Feature(number, "traffic_sign", points_m, COV_M2, Existence(0.9, 0.02, 0.08, 0.1), **values)


LANE = Feature(
    2**62 + 1, "lane_boundary", np.array([[-15.0, -3.5, 30.0], [9.0, -2.0, 30.25]]), COV_M2, part=3, cuts=1, hits=9
)
HELD = FeatureTile.of(TILE, 3, [sign(1), sign(2, attributes=(("code", "274-50"),)), LANE])
NEXT = FeatureTile.of(TILE, 4, [sign(2, x_m=4.5, vehicles=2), sign(7), LANE])
BLOB = TileBlob(TILE, 4, NEXT.sha, *encode_content(NEXT))
DELTA = encode_content_delta(HELD, NEXT)

GOLDEN: dict[str, Any] = {
    "TileRequest-features": TileRequest(3, HELD.sha, (32,)),
    "TilesRequest-features": TilesRequest.of([HeldVersion(TILE, 3, HELD.sha)], codecs=(32,)),
    "TileReply-blob-features": TileReply("blob", BLOB),
    "TileReply-delta-features": TileReply("delta", delta=CodedDelta(TILE, 4, NEXT.sha, DELTA)),
    "TilesReply-blob_and_delta-features": TilesReply(
        (TileAnswer("blob", 4, NEXT.sha[:4], 32, BLOB.body), TileAnswer("delta", 4, NEXT.sha[:4], 0, DELTA))
    ),
    "TileUpdate-features": TileUpdate(
        TILE, "signs", 4, 3, NEXT.sha, HELD.sha, "merged", None, DELTA, put_voxels=2, removed_voxels=1
    ),
}


def opened(value: Any) -> list[FeatureTile]:
    """The tiles that a message brings to whoever holds `HELD`; SchemaError."""
    if isinstance(value, TileReply) and value.blob:
        found: Any = [content_of(value.blob)]
    elif isinstance(value, TileReply) and value.delta:
        found = [tile_after(value.delta, HELD)]
    elif isinstance(value, TileUpdate):
        found = [updated(value, HELD)]
    else:
        found = [content_of_answer(TILE, one, FeatureTile, HELD) for one in getattr(value, "answers", ())]
    return list(found)


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_bytes_and_values_agree(name: str) -> None:
    data = (GOLDEN_DIR / f"{name}.bin").read_bytes()
    assert GOLDEN[name].encode() == data
    assert type(GOLDEN[name]).decode(data) == GOLDEN[name]
    assert all(tile == NEXT for tile in opened(type(GOLDEN[name]).decode(data)))


def test_every_golden_file_has_its_value() -> None:
    assert {path.stem for path in GOLDEN_DIR.iterdir()} == set(GOLDEN)


@pytest.mark.parametrize("name", GOLDEN)
def test_damage_is_a_schema_error_or_the_same_tile(name: str) -> None:
    rng, data, kind = random.Random(name), GOLDEN[name].encode(), type(GOLDEN[name])
    for _ in range(250):
        with contextlib.suppress(SchemaError):
            value = kind.decode(mutated(data, rng))
            assert all(tile.features == NEXT.features for tile in opened(value))


def test_content_without_its_hash_is_refused() -> None:
    with pytest.raises(WrongHash, match="claimed is 0001020304050607"):
        content_of(TileBlob(TILE, 4, SHA, 32, BLOB.body))
    with pytest.raises(WrongHash, match="does not fit version 3"):
        tile_after(CodedDelta(TILE, 4, NEXT.sha, DELTA), FeatureTile(TILE, 3, HELD.features[1:]))
    with pytest.raises(BadValue, match=r"tile .* version 4: encoded features"):
        content_of(TileBlob(TILE, 4, NEXT.sha, 32, BLOB.body[:-1]))
    with pytest.raises(BadValue, match="codec 33 is unknown"):
        content_of(TileBlob(TILE, 4, NEXT.sha, 33, BLOB.body))


def write_missing_golden_files() -> None:
    """`python tests/schemas/test_feature_tiles_on_the_wire.py` writes those that are missing; none is ever changed."""
    GOLDEN_DIR.mkdir(exist_ok=True)
    for name, value in GOLDEN.items():
        path = GOLDEN_DIR / f"{name}.bin"
        if not path.exists():
            path.write_bytes(value.encode())


if __name__ == "__main__":
    write_missing_golden_files()
