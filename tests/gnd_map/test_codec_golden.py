"""Bytes that were published once mean the same for ever, on every machine."""

import json
from typing import Any

import numpy as np
import pytest
from golden_codecs import ENTRIES, FILE, MASK, OTHER, TILE, flags_of, hashes, messages, state, tables

from gnd.gnd_map.codec import (
    CODECS,
    LATTICES,
    REPORT,
    Lattice,
    decode_delta,
    decode_flags,
    decode_mask,
    decode_measured,
    decode_tiles,
    is_on,
    snap,
)
from gnd.gnd_map.codec.range_tile import decode_tile_by_set
from gnd.gnd_map.gaussian import Gaussians

GOLDEN: dict[str, Any] = json.loads(FILE.read_text())
BODIES = {name: bytes.fromhex(body) for name, body in GOLDEN["messages"].items()}
ZSTANDARD = {1, 5, 6, 7}


def test_every_message_has_golden_bytes() -> None:
    assert set(messages()) == set(BODIES)


@pytest.mark.parametrize("name", [n for n in BODIES if not any(n.endswith(f"codec {i}") for i in ZSTANDARD)])
def test_the_bytes_are_the_golden_ones(name: str) -> None:
    assert messages()[name].hex() == BODIES[name].hex()


@pytest.mark.parametrize("codec", CODECS.values(), ids=lambda codec: codec.name)
def test_golden_tiles_are_read(codec: Any) -> None:
    """Also those of Zstandard, whose library may compress otherwise one day."""
    assert codec.decode(TILE, BODIES[f"tile, codec {codec.codec_id}"]) == state(
        codec.lattice or LATTICES["standard"], 0
    )
    assert codec.decode(TILE, BODIES[f"nothing, codec {codec.codec_id}"]) == Gaussians.empty()


@pytest.mark.parametrize("name", [name for name in BODIES if ", set " in name])
def test_golden_tiles_of_every_set_are_read(name: str) -> None:
    lattice, number = LATTICES[name.split(", ")[1]], int(name.rpartition(" ")[2])
    assert BODIES[name][0] == number
    assert decode_tile_by_set(TILE, BODIES[name], lattice) == state(lattice, 0)


@pytest.mark.parametrize("lattice", LATTICES.values(), ids=lambda lattice: lattice.name)
def test_golden_deltas_are_read(lattice: Lattice) -> None:
    assert decode_delta(TILE, state(lattice, 0), BODIES[f"delta, {lattice.name}"]) == state(lattice, 1)


def test_golden_reports_are_read() -> None:
    base, empty = state(LATTICES["standard"], 0), Gaussians.empty()
    first, second = decode_flags([(TILE, base), (OTHER, empty)], BODIES["flags"])
    assert np.array_equal(first.voxel_id, flags_of(base).voxel_id)
    assert np.array_equal(first.change_class, flags_of(base).change_class)
    assert second.voxel_id.tolist() == [7]
    measured = [state(REPORT, 1), state(REPORT, 0)]
    asked = [(TILE, base, measured[0].voxel_id), (OTHER, empty, measured[1].voxel_id)]
    assert decode_measured(asked, BODIES["measured"]) == measured
    assert decode_tiles(BODIES["tiles"]) == ENTRIES
    assert np.array_equal(decode_mask(BODIES["mask"], len(MASK)), MASK)


def test_integers_stand_for_the_same_bits_for_ever() -> None:
    assert tables() == GOLDEN["tables"]
    assert hashes() == GOLDEN["hashes"]


@pytest.mark.parametrize("lattice", [*LATTICES.values(), REPORT], ids=lambda lattice: lattice.name)
def test_golden_states_lie_on_their_lattice(lattice: Lattice) -> None:
    for number in (0, 1):
        g = state(lattice, number)
        assert is_on(g, lattice)
        assert snap(g, lattice) == g
