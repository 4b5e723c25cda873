"""Which parameters there are, and who turns them: `python tests/deploy/parameter_inventory.py [FOLDER]`.

Counts the fields with defaults of all parameter classes of the product (dataclasses named ...Parameters, ...Limits,
...Config or ...Noise), whether each is a documented setting, and where each is given another value: in the product, the
studies, the tests. The simulator's worlds and sensors are inputs, not parameters.
"""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

PRODUCT = ("cloud_merger", "deploy", "fleet_bus", "gnd_map", "schemas", "tile_client", "tile_store", "vehicle_agent")
NAMES = re.compile(r"(Parameters|Limits|Config|Noise)$")


@dataclass
class Parameter:
    """A field: class, name, file, type; whether it is a setting or holds a group; the files in which it is given."""

    owner: str
    name: str
    file: Path
    kind: str
    is_setting: bool
    is_group: bool = False
    given: set[str] = field(default_factory=set)


def inventory(root: Path) -> list[Parameter]:
    """All parameters of a checkout."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in _files(root)}
    found = [
        one for path, tree in trees.items() if path.relative_to(root).parts[0] in PRODUCT for one in _of(path, tree)
    ]
    owners = {one.owner for one in found}
    for one in found:
        one.is_group = any(re.search(rf"\b{owner}\b", one.kind) for owner in owners)
    by_class: dict[tuple[str, str], list[Parameter]] = {}
    by_name: dict[str, list[Parameter]] = {}
    for one in found:
        by_class.setdefault((one.owner, one.name), []).append(one)
        by_name.setdefault(one.name, []).append(one)
    for path, tree in trees.items():
        where = str(path.relative_to(root))
        for callee, name in _keywords(tree):
            turned = by_name.get(name, []) if callee == "replace" else by_class.get((callee, name), [])
            for one in turned:
                if one.file != path or callee == one.owner:
                    one.given.add(where)
    return found


def _files(root: Path) -> Iterator[Path]:
    for folder in (*PRODUCT, "studies", "benchmarks", "tests"):
        yield from (p for p in sorted((root / folder).rglob("*.py")) if "generated" not in p.parts)


def _of(path: Path, tree: ast.Module) -> Iterator[Parameter]:
    for node in ast.walk(tree):
        if not (isinstance(node, ast.ClassDef) and NAMES.search(node.name)):
            continue
        if not any("dataclass" in ast.unparse(one) for one in node.decorator_list):
            continue
        for line in node.body:
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                value = line.value
                declared = isinstance(value, ast.Call) and ast.unparse(value.func) == "setting"
                if value is None or ast.unparse(value).startswith("setting(..."):
                    continue  # what must be given is an input
                yield Parameter(node.name, line.target.id, path, ast.unparse(line.annotation), declared)


def _keywords(tree: ast.Module) -> Iterator[tuple[str, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            callee = ast.unparse(node.func).split(".")[-1]
            for keyword in node.keywords:
                if keyword.arg:
                    yield callee, keyword.arg


def main() -> None:
    """Print the counts, and what is neither a setting nor ever given."""
    found = [one for one in inventory(Path(sys.argv[1] if len(sys.argv) > 1 else ".").resolve()) if not one.is_group]
    settings = [one for one in found if one.is_setting]
    given = [one for one in found if one.given]
    print(f"{len(found)} parameters in {len({(o.file, o.owner) for o in found})} classes")
    print(f"{len(settings)} are settings, {len(given)} are given somewhere")
    for package in PRODUCT:
        here = [one for one in found if package in one.file.parts]
        print(f"  {package}: {len(here)}, settings {sum(one.is_setting for one in here)}")
    for one in found:
        if not one.is_setting and not one.given:
            print(f"nobody turns {one.owner}.{one.name}")


if __name__ == "__main__":
    main()
