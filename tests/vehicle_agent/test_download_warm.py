"""Reading and making tiles compiles nothing on the road."""

import json
import subprocess
import sys
import textwrap

import pytest

PROGRAM = textwrap.dedent(
    """
    import json, sys
    import numpy as np
    from gnd.gnd_map.codec import LATTICES, best_codec, decode_delta, encode_delta, snap
    from gnd.gnd_map.tile import Tile
    from gnd.gnd_map.tile_id import TileId
    from gnd.schemas.tiles import blob_of, tile_of
    from gnd.vehicle_agent.warm import _map_of, _room, warm_up
    from gnd.gnd_map.geodesy import LocalFrame
    from gnd.gnd_map.grid import GridFrame
    import gnd.vehicle_agent.agent

    warm_up()
    def compiled():
        kernel_modules = [m for name, m in sys.modules.items() if name.startswith("gnd_map.")]
        return {
            f"{m.__name__}.{k}": len(v.signatures)
            for m in kernel_modules for k, v in vars(m).items() if hasattr(v, "signatures")
        }
    before = compiled()
    tile_id = TileId.from_geodetic(0.6555, 2.2173)
    held = _map_of(_room(), GridFrame.around(LocalFrame.of_tile(tile_id), [tile_id]))
    tile = next(t for t in (held.tile(t) for t in held.tiles) if t is not None and len(t.gaussians) > 50)
    for name in ("standard", "compact"):
        gaussians = snap(tile.gaussians, LATTICES[name])
        came = tile_of(blob_of(Tile(tile.tile_id, 1, gaussians), best_codec(gaussians)))
        fewer = gaussians.take(np.arange(9, len(gaussians)))
        assert decode_delta(tile.tile_id, came.gaussians, encode_delta(tile.tile_id, gaussians, fewer)) == fewer
    after = compiled()
    print(json.dumps({k: (before.get(k, 0), n) for k, n in after.items() if n != before.get(k, 0)}))
    """
)


@pytest.mark.slow
def test_tiles_and_deltas_need_no_kernel_that_was_not_warmed() -> None:
    done = subprocess.run([sys.executable, "-W", "error", "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {}, "compiled on the road, or for other arguments than were warmed"
