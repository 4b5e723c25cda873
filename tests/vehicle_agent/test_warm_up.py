"""What a fork server may hold ready: kernels and imports, but no thread, no session and nothing of the server side."""

import json
import os
import subprocess
import sys
import textwrap

import pytest

PROGRAM = textwrap.dedent(
    """
    import json, sys, threading
    import gnd.vehicle_agent.agent
    from gnd.vehicle_agent.detect import fit_kernel, kernel, recent_map
    from gnd.vehicle_agent.warm import warm_up
    from gnd.vehicle_agent.localise import kernels, packed_scan, registration, rolling_kernels
    from gnd.vehicle_agent.features.poles import kernels as poles, place_kernels as places
    from gnd.gnd_map.codec import kernels as coders, voxel_kernels
    INNER = {"cholesky", "newton_step", "principal", "by_levers", "descend", "rotation_of", "without_hints"}
    USED = (coders.code_bit, coders.code_bits, coders.code_flags, coders.code_plain, voxel_kernels.code_voxels)
    FORMS = {"place_rays": 2}  # float32 from a centre, float64 in the map frame
    before = len(kernel.cast_rays.signatures)
    warm_up()
    first = {k: len(v.signatures) for k, v in vars(kernel).items() if hasattr(v, "signatures")}
    warm_up()
    again = {k: len(v.signatures) for k, v in vars(kernel).items() if hasattr(v, "signatures")}
    cold = [
        f"{m.__name__}.{k}" for m in (kernels, packed_scan, rolling_kernels, places, poles, fit_kernel, recent_map)
        for k, v in vars(m).items()
        if hasattr(v, "signatures") and not k.startswith("_") and k not in INNER
        and len(v.signatures) != FORMS.get(k, 1)
    ]
    print(json.dumps({
        "cold": cold, "coders": [k.__name__ for k in USED if len(k.signatures) != 1],
        "before": before, "after": first["cast_rays"], "same": first == again, "threads": threading.active_count(),
        "modules": sorted({m.split(".")[0] for m in sys.modules} & {"sklearn", "matplotlib", "pandas", "rich"}),
        "stats": "scipy.stats" in sys.modules,
    }))
    """
)


@pytest.mark.slow
def test_warming_compiles_the_kernels_and_starts_nothing() -> None:
    numba = os.environ | {"GND_KERNELS": "numba"}  # a library has compiled all of them before
    command = [sys.executable, "-W", "error", "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=numba)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["before"] == 0
    assert found["after"] == 1, "the drive would compile another signature than the one that was warmed"
    assert found["same"]
    assert found["cold"] == [], "compiled on the road, or twice"
    assert found["coders"] == [], "compiled when the first report is packed"
    assert found["threads"] == 1
    assert found["modules"] == []
    assert not found["stats"]
