"""After warming up no kernel of the codecs is compiled any more while a client waits."""

import importlib
import pkgutil

import numpy as np
from store_helpers import TILE

import gnd.gnd_map.codec
from gnd.gnd_map.codec import LATTICES, PREFERRED, QUICK, best_codec, codec_of, decode_delta, encode_delta, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.tile_store.warm import warm_up


def compiled() -> dict[str, int]:
    """How many signatures of each kernel of the codecs are ready."""
    modules = [
        importlib.import_module(f"gnd.gnd_map.codec.{m.name}") for m in pkgutil.iter_modules(gnd.gnd_map.codec.__path__)
    ]
    return {
        f"{module.__name__}.{name}": len(found.signatures)
        for module in modules
        for name, found in vars(module).items()
        if hasattr(found, "signatures") and hasattr(found, "py_func")
    }


def test_a_server_that_has_warmed_up_compiles_nothing_more() -> None:
    warm_up()
    before = compiled()
    assert sum(before.values()) > 0
    rng = np.random.default_rng(0)
    ids = np.sort(rng.choice(40_000, 500, replace=False)).astype(np.int32)
    spread = rng.uniform(-0.2, 0.2, (500, 3, 3))
    cov_m2 = (spread @ np.swapaxes(spread, 1, 2))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    counts = rng.integers(20, 5000, 500).astype(np.int32)
    mean_m = rng.uniform(-0.5, 0.5, (500, 3)).astype(np.float32)
    plain = Gaussians(ids, counts, np.full(500, 20, np.int32), mean_m, cov_m2)
    for lattice in LATTICES.values():
        new = snap(plain, lattice)
        base = new.take(np.arange(0, 500, 2))
        for codec in (codec_of(best_codec(new, known)) for known in (PREFERRED, QUICK)):
            assert codec.decode(TILE, codec.encode(TILE, new)) == new
        assert decode_delta(TILE, base, encode_delta(TILE, base, new)) == new
        assert decode_delta(TILE, new, encode_delta(TILE, new, base)) == base
    assert compiled() == before
