"""A class name stands in one module only, so that a reader never has to ask which one is meant."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = (
    "vehicle_agent", "cloud_merger", "tile_store", "tile_client", "schemas", "deploy", "gnd_map", "fleet_bus",
    "fleet_sim", "studies",
)  # fmt: skip


def test_no_class_name_stands_in_two_modules() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    modules = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    modules += sorted((ROOT / "src" / "gnd").glob("*.py"))  # beside it are links to the folders
    for path in modules:
        if "generated" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found[node.name].append(str(path.relative_to(ROOT)))
    assert len(found) > 500
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}
