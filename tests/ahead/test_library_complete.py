"""Every kernel that code of vehicles, shards and tile servers calls is in the library, or is named here with why not.

What is not there is compiled on the road: seconds of work, and the 100 MB of a compiler in a running vehicle.
"""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from suite_kernels import LIBRARY, has_library

from gnd.ahead.library import load, name_of
from gnd.gnd_map.jit import kernels

SRC = Path(__file__).parents[2] / "src"
PARTS = ("gnd_map", "schemas", "tile_store", "tile_client", "cloud_merger", "vehicle_agent", "fleet_bus")
DECORATORS = {"kernel", "bare", "bare_inlined", "pasted"}
NOT_ON_THE_ROAD = ("vehicle_agent.map_build", "vehicle_agent.importers", "vehicle_agent.features.mapping")
"""Maps are built, recordings imported and lanes drawn by commands that may compile."""
EXCEPTIONS = {
    "gnd.vehicle_agent.localise.register_kernels:linearise_pose": "only tests call `linearised`, to compare with it",
}


def modules() -> Iterator[tuple[str, ast.Module]]:
    for part in PARTS:
        for path in sorted((SRC / "gnd" / part).resolve().rglob("*.py")):
            inside = path.relative_to((SRC / "gnd" / part).resolve()).with_suffix("").parts
            name = ".".join((part, *inside)).removesuffix(".__init__")
            if not name.startswith(NOT_ON_THE_ROAD):
                yield f"gnd.{name}", ast.parse(path.read_text(encoding="utf-8"))


def is_kernel(function: ast.FunctionDef) -> bool:
    names = [one.func if isinstance(one, ast.Call) else one for one in function.decorator_list]
    return any(isinstance(name, ast.Name) and name.id in DECORATORS for name in names)


def called(tree: ast.AST) -> Iterator[str]:
    """Names that code outside of kernels calls or hands on, as they stand there: `name` or `module.name`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef) and is_kernel(node):
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield f"{node.value.id}.{node.attr}"
        yield from called(node)


def from_python() -> set[str]:
    """Kernels that code outside of kernels uses, as `module:name`."""
    trees = dict(modules())
    own = {
        module: {one.name for one in ast.walk(tree) if isinstance(one, ast.FunctionDef) and is_kernel(one)}
        for module, tree in trees.items()
    }
    found = set[str]()
    for module, tree in trees.items():
        names = {name: f"{module}:{name}" for name in own[module]}
        for one in ast.walk(tree):
            if isinstance(one, ast.ImportFrom) and one.module is not None:
                for it in one.names:
                    as_name, inner = it.asname or it.name, f"{one.module}.{it.name}"
                    if it.name in own.get(one.module, ()):
                        names[as_name] = f"{one.module}:{it.name}"
                    names |= {f"{as_name}.{name}": f"{inner}:{name}" for name in own.get(inner, ())}
        found |= {names[name] for name in set(called(tree)) & names.keys()}
    return found


@pytest.mark.slow
def test_what_programs_on_the_road_call_is_in_the_library() -> None:
    if not has_library():
        pytest.skip("no library of the kernels as they are: `make test` compiles it")
    used = from_python()
    held = set(load(LIBRARY).kernels)
    assert {"gnd.cloud_merger.votes:_tally", "gnd.vehicle_agent.detect.recent_map:extent_of"} <= used
    assert sorted(used - held - EXCEPTIONS.keys()) == []
    assert sorted(EXCEPTIONS.keys() - used) == []


def test_a_kernel_that_only_python_calls_is_seen() -> None:
    source = "@kernel\ndef inner(): ...\n@kernel\ndef outer():\n    inner()\ndef plain():\n    outer()\n"
    assert {"outer"} <= set(called(ast.parse(source)))
    assert "inner" not in set(called(ast.parse(source)))


def test_names_are_those_of_the_library() -> None:
    importlib.import_module("gnd.cloud_merger.votes")
    assert "gnd.cloud_merger.votes:_tally" in {name_of(one) for one in kernels()}
