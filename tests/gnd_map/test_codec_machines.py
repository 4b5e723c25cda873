"""The same integers, floats and bytes whatever vector instructions a machine has."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from codec_samples import TILES, changed, street
from golden_codecs import messages

from gnd.gnd_map.codec import CODECS, LATTICES, REPORT, encode_delta, snap
from gnd.gnd_map.tile import content_sha


def fingerprint() -> str:
    """Of streets snapped onto every lattice and coded by every codec, deltas between them, and the golden messages."""
    found = hashlib.sha256(b"".join(messages().values()))
    for tile_id in TILES:
        rng = np.random.default_rng(21)
        g = street(tile_id, rng, 400)
        later = changed(g, tile_id, rng, 0.1)
        for lattice in (*LATTICES.values(), REPORT):
            found.update(content_sha(tile_id, snap(g, lattice)))
            if lattice is not REPORT:
                found.update(encode_delta(tile_id, g, snap(later, lattice)))
        for codec in CODECS.values():
            found.update(codec.encode(tile_id, g if codec.lattice is None else snap(g, codec.lattice)))
    return found.hexdigest()


def optional_features() -> list[str]:
    """Vector instructions that numpy uses where it finds them, and has found here."""
    core = np._core._multiarray_umath  # type: ignore[attr-defined]
    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]


def test_machines_without_vector_instructions_give_the_same_bytes() -> None:
    features = optional_features()
    if not features:
        pytest.skip("this machine has no vector instructions that numpy could do without")
    here = Path(__file__).parent
    environment = os.environ | {
        "NPY_DISABLE_CPU_FEATURES": " ".join(features),
        "PYTHONPATH": os.pathsep.join([str(here.parents[1] / "src"), str(here)]),
    }
    program = "import test_codec_machines as t; assert not t.optional_features(); print(t.fingerprint())"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == fingerprint()
