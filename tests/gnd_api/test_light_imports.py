"""What importing loads, in a fresh interpreter: modules, not seconds."""

import ast
import subprocess
import sys

import pytest
from api_testing import ROOT

import gnd

HEAVY = ("numba", "llvmlite", "scipy", "sklearn", "gtsam", "small_gicp", "matplotlib")
MESSAGES = (
    "changes", "drive", "drive_mcap", "features", "keys", "packed", "poses_mcap", "report_states", "tiles",
    "tiles_batch", "traffic", "trajectory_files", "updates", "upload_head",
)  # fmt: skip


def loaded_by(program: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a program."""
    code = f"import sys\n{program}\nprint(sorted({{name.split('.')[0] for name in sys.modules}}))"
    env = {"PYTHONPATH": str(ROOT / "src"), "GND_KERNELS": "numba"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/", env=env)
    assert done.returncode == 0, done.stderr
    return set(ast.literal_eval(done.stdout.splitlines()[-1]))


def test_import_gnd_loads_nothing_but_itself() -> None:
    theirs = loaded_by("import gnd") - loaded_by("import importlib, typing")
    assert theirs == {"gnd"}


@pytest.mark.parametrize("name", gnd.__all__)
def test_a_name_of_the_api_loads_nothing_heavy(name: str) -> None:
    assert loaded_by(f"import gnd; gnd.{name}").isdisjoint(HEAVY)


def test_the_messages_load_nothing_heavy() -> None:
    assert loaded_by("; ".join(f"import gnd.schemas.{name}" for name in MESSAGES)).isdisjoint(HEAVY)


def test_each_command_but_those_that_compute_loads_nothing_heavy() -> None:
    light = ("watch_cli", "map_cli")
    assert loaded_by("; ".join(f"import gnd.deploy.{name}" for name in light)).isdisjoint(HEAVY)


def test_a_shard_loads_gtsam_when_it_maps_a_road_and_not_before() -> None:
    assert "gtsam" not in loaded_by("import gnd.cloud_merger.merger")


def test_a_shard_loads_scipy_when_it_merges_features_and_not_before() -> None:
    """Nor does one that clusters by kernels, as all do that do not follow the paper to the letter."""
    assert loaded_by("import gnd.cloud_merger.cli, gnd.cloud_merger.merger").isdisjoint(HEAVY)


def test_a_kernel_loads_numba_when_it_is_called_and_not_before() -> None:
    imports = "import numpy as np; from gnd.gnd_map.codec import decode_tiles, encode_tiles"
    assert "numba" not in loaded_by(imports)
    assert "numba" in loaded_by(f"{imports}; assert list(decode_tiles(encode_tiles([(3, 1)]))) == [(3, 1)]")


def test_every_name_is_there_and_listed() -> None:
    assert set(gnd.__all__) <= set(dir(gnd))
    for name in gnd.__all__:
        assert getattr(gnd, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = gnd.nothing


def test_type_checkers_see_the_same_names() -> None:
    """What mypy reads (the imports under TYPE_CHECKING) is what is loaded at run time."""
    tree = ast.parse((ROOT / "src" / "gnd" / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == gnd._WHERE
    assert sorted(seen) == gnd.__all__
