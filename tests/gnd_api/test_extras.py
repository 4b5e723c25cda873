"""The base installation: a client, a reader of maps and the messages work without what only extras bring."""

import importlib.metadata
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from api_testing import HERE, ROOT, Cloud, Program, gaussian_tile, sign_tile

from gnd import extras
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import write_world

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {name: PROJECT["optional-dependencies"][name] for name in ("vehicle", "cloud", "sim", "serve", "lanes")}


def name_of(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement)[0].lower().replace("_", "-")


def with_dependencies(requirements: list[str]) -> set[str]:
    """Names of what they install, and what that needs."""
    found: set[str] = set()
    left = [name_of(one) for one in requirements]
    while left:
        name = left.pop()
        if name in found:
            continue
        found.add(name)
        try:
            needs = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        left += [name_of(one) for one in needs if "extra ==" not in one]
    return found


def foreign_modules() -> set[str]:
    """All installed modules that the base installation does not bring."""
    base = with_dependencies(PROJECT["dependencies"])
    by_module = importlib.metadata.packages_distributions()
    foreign = {
        module
        for module, names in by_module.items()
        if module != "gnd" and base.isdisjoint(name.lower().replace("_", "-") for name in names)
    }
    return foreign | extras.LEFT_OUT  # one of them is a bare shared library, which has no line in the table above


BLOCKED = """
import importlib.abc, sys
class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Blocked())
"""


@pytest.fixture
def bare(start: Callable[..., Program]) -> Callable[..., Program]:
    """Starts a program that can import only what the base installation brings."""
    modules = foreign_modules()
    assert {"gtsam", "scipy", "sklearn", "matplotlib", "psutil", "pytest"} <= modules
    assert {"numba", "numpy", "zenoh", "apsw", "google", "mcap", "click", "rich", "prometheus_client"}.isdisjoint(
        modules
    )
    head = BLOCKED.format(modules=modules)
    return lambda program, *arguments: start("-c", head + program, *arguments)


CLIENT = """
import gnd
with gnd.connect(sys.argv[1]) as client:
    print("tiles", [(tile.tile_id.morton, len(tile.gaussians)) for tile in client.tiles("13033/**")], flush=True)
    print("signs", [len(tile.features) for tile in client.tiles("13033/**", layer="signs")], flush=True)
    stream = client.subscribe("13033/**", layers=("ndt", "signs"))
    print("listening", flush=True)
    for update in stream:
        print("update", update.layer, update.version, update.tile.sha.hex(), flush=True)
"""


def test_a_client_reads_and_follows_the_map(cloud: Cloud, bare: Callable[..., Program]) -> None:
    program = bare(CLIENT, cloud.endpoint)
    assert program.line("tiles") == f"tiles [({HERE.morton}, 3), ({HERE.morton + 1}, 1)]"
    assert program.line("signs") == "signs [3]"
    program.line("listening")
    for layer, tile in (("ndt", gaussian_tile(HERE, 5, 70, 99)), ("signs", sign_tile(HERE, 2, 3, 5))):
        cloud.publish(tile, layer)  # a notice that comes before the subscription is found by the catalog
        assert program.line(f"update {layer}") == f"update {layer} 2 {tile.sha.hex()}"


MAP = """
import gnd
with gnd.Map(sys.argv[1]) as opened:
    found = opened.gaussians("13033/**")
    print(opened.layers, len(found), len(opened.features(layer="signs")), opened.diff(1, 2, tile=sys.argv[2]).new)
"""


def test_a_map_is_read(cloud: Cloud, bare: Callable[..., Program]) -> None:
    cloud.publish(gaussian_tile(HERE, 5, 70, 99, 100))
    program = bare(MAP, str(cloud.store.path), HERE.path)
    assert program.line("(") == "('ndt', 'signs') 5 4 2"
    assert program.end() == 0


COMMANDS = {
    "sim world picture street.json street.png": ("sim", "scipy"),
    "merger --id m": ("cloud", "scipy"),
    "localise drive.mcap --map map.sqlite": ("vehicle", "gtsam"),
    "agent --drive drive.mcap": ("vehicle", "gtsam"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_without_its_extra_says_which_in_one_line(
    bare: Callable[..., Program], command: str, tmp_path: Path
) -> None:
    write_world(street(1, StreetOptions(length_m=100.0)), tmp_path / "street.json")
    program = bare("from gnd.deploy.cli import main; sys.argv[0] = 'gnd'; main()", *command.split())
    assert program.end() == 2, program.lines
    extra, module = COMMANDS[command]
    (line,) = program.lines
    assert re.fullmatch(rf"gnd: {module} is not installed; it comes with: pip install 'gnd-fleet\[{extra}\]'", line)


@pytest.mark.parametrize(
    "command",
    [
        "--help",
        "map --help",
        "watch --help",
        "router --help",
        "localise --help",
        "agent --help",
        "merger --help",
        "traffic --help",
        "config show fleet",
        "config show store",
    ],
)
def test_commands_that_need_no_extra_work(bare: Callable[..., Program], command: str) -> None:
    program = bare("from gnd.deploy.cli import main; sys.argv[0] = 'gnd'; main()", *command.split())
    assert program.end() == 0, program.lines


def test_a_fleet_without_all_extras_names_them_before_anything_is_written(
    bare: Callable[..., Program], tmp_path: Path
) -> None:
    program = bare(
        "from gnd.deploy.cli import main; sys.argv[0] = 'gnd'; main()", "fleet", "--out", str(tmp_path / "f")
    )
    assert program.end() == 2, program.lines
    (line,) = program.lines
    missing = ", ".join(sorted(extras.OF_A_FLEET))
    assert line == f"gnd: {missing}: not installed; this command needs: pip install 'gnd-fleet[all]'"
    assert not (tmp_path / "f").exists()


def test_localise_without_its_extra_says_which(bare: Callable[..., Program]) -> None:
    program = bare("import gnd\ntry: gnd.localise('a.mcap', 'b')\nexcept gnd.MissingExtra as error: print(error)")
    assert program.end() == 0, program.lines
    assert "comes with: pip install 'gnd-fleet[vehicle]'" in program.lines[-1]


def test_a_vehicle_without_its_extra_says_so_when_it_is_made(bare: Callable[..., Program]) -> None:
    program = bare("import gnd\ntry: gnd.Vehicle('m.sqlite', None)\nexcept gnd.MissingExtra as error: print(error)")
    assert program.end() == 0, program.lines
    assert "comes with: pip install 'gnd-fleet[vehicle]'" in program.lines[-1]


def test_the_page_without_its_extra_says_which(bare: Callable[..., Program]) -> None:
    program = bare("from gnd.deploy.cli import main; sys.argv[0] = 'gnd'; main()", "serve", "map.sqlite")
    assert program.end() == 2, program.lines
    assert "comes with: pip install 'gnd-fleet[serve]'" in program.lines[-1]


def test_the_table_of_what_is_left_out_is_that_of_pyproject() -> None:
    base = with_dependencies(PROJECT["dependencies"])
    brought = {name_of(one) for requirements in EXTRAS.values() for one in requirements} - base
    module_of = {"scikit-learn": "sklearn", "small-gicp": "small_gicp"}
    assert {module_of.get(name, name) for name in brought} == extras.LEFT_OUT - {"mpl_toolkits"}
    assert {*extras.EXTRA_OF.values(), "serve", "lanes"} == set(EXTRAS)
    assert PROJECT["optional-dependencies"]["all"] == ["gnd-fleet[vehicle,cloud,sim,serve]"]
    assert not base & {"gtsam", "scipy", "scikit-learn", "small-gicp", "matplotlib", "pyproj"}
