"""examples/subscribe.py: a program outside the project that knows only zenoh and our messages."""

import ast
import re

import pytest
from bus_testing import REPOSITORY, script, stays, wait_for

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import catalog_key, catalog_keys, update_key
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.schemas.updates import TileUpdate

EXAMPLE = REPOSITORY / "examples" / "subscribe.py"
INSIDE = TileId.from_path("13033/03021/23031/22102")
NEIGHBOUR_REGION = TileId.from_path("13033/03022/00000/00000")


NEIGHBOUR = TileId.from_path("13033/03021/23031/22103")


def catalog(version: int) -> bytes:
    """Of two tiles, one of which never changes."""
    return Catalog((CatalogEntry(INSIDE, version, bytes(32)), CatalogEntry(NEIGHBOUR, 1, bytes(32)))).encode()


def update(tile: TileId, version: int) -> TileUpdate:
    return TileUpdate(tile, "ndt", version, version - 1, bytes(32), bytes(32) if version > 1 else b"", "merged")


def test_it_receives_its_region_and_nothing_outside(router, client):
    bus = client(router)
    with script(EXAMPLE.read_text(), "13033/03021", "--connect", router) as program:
        program.wait_line("listening to gnd/v1/update/ndt/13033/03021/**")

        def publish_both(version: int) -> None:
            for tile in (NEIGHBOUR_REGION, INSIDE):
                bus.publish(update_key("ndt", tile), update(tile, version).encode(), kind="update")

        version = iter(range(1, 10_000))
        wait_for(lambda: publish_both(next(version)) or len(program.lines) >= 4, "three updates")
        stays(lambda: True, "", for_s=0.1)
        updates = program.lines[1:]
    assert all(re.fullmatch(rf"{INSIDE.path} v\d+ -> v\d+ merged", line) for line in updates)


def test_a_lost_notice_is_found_by_the_catalog(router, client):
    bus, versions = client(router), iter(range(3, 1000))
    bus.serve(
        catalog_keys("ndt"),
        lambda request: [(catalog_key("ndt", INSIDE.district), catalog(next(versions)))] if request.is_wild else b"",
    )
    with script(EXAMPLE.read_text(), "13033/03021", "--connect", router, "--every", "0.05") as program:
        program.wait_line(f"{INSIDE.path} v3 -> v4 by the catalog")
    assert not any(NEIGHBOUR.path in line for line in program.lines)


def test_it_imports_only_zenoh_and_schemas():
    tree = ast.parse(EXAMPLE.read_text())
    imported = {
        ".".join((node.module or "").split(".")[:2]) if isinstance(node, ast.ImportFrom) else node.names[0].name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert imported == {"argparse", "time", "zenoh", "gnd.schemas"}
    assert len(EXAMPLE.read_text().splitlines()) <= 45


@pytest.mark.parametrize("region", ["13033/0302", "elsewhere"])
def test_half_a_chunk_is_no_region(router, region):
    with script(EXAMPLE.read_text(), region, "--connect", router) as program:
        assert program.wait() == 1
        assert "BadKey" in program.lines[-1]
