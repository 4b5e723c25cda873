"""The short reports of the ingest benchmark: made of a drive, kept, and told by many vehicles."""

from pathlib import Path

import pytest

from gnd.cloud_merger.expanding import expand
from gnd.gnd_map.tile import Tile
from gnd.schemas.packed import PackedReport
from studies.ingest import from_many
from studies.short_corpus import corpus


@pytest.mark.slow
def test_a_drive_gives_short_reports_that_the_cloud_understands_and_others_may_tell(tmp_path: Path) -> None:
    found = corpus(tmp_path / "corpus", drives=1, length_m=100.0, scans=16)
    again = corpus(tmp_path / "corpus", drives=1, length_m=100.0, scans=16)
    assert [one.packed for one in again.reports] == [one.packed for one in found.reports], "kept"
    many = from_many(found.reports, 5, "car")
    assert len({one.packed.report_id for one in many}) == 5
    assert {one.packed.vehicle for one in many} == {f"car-{n}" for n in range(5)}
    held = {tile.tile_id.morton: tile for tile in found.tiles()}
    for one in many:
        packed = PackedReport.decode(one.packed.encode())
        first = one.whole.district.first_morton
        bases = [Tile(held[first + i].tile_id, version, held[first + i].gaussians) for i, version in packed.tiles]
        assert expand(packed, "ndt", one.whole.district, bases).report_id == one.whole.report_id
