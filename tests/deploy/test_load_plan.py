import numpy as np
import pytest
from load_testing import LENGTH_M, against, make_run, put_vehicle, street_tiles, whole_report

from gnd.deploy.errors import LoadError
from gnd.deploy.load.drives import KeptRuns, read_street
from gnd.deploy.load.plan import LoadOptions, Timetable, shared_out
from gnd.deploy.load.streets import Streets
from gnd.deploy.run_folder import RunFolder
from gnd.schemas.keys import change_key
from gnd.schemas.packed import PackedReport
from gnd.vehicle_agent.link.outbox import Outbox


def table(**options):
    return Timetable(LoadOptions(**options), ((20.0, 60.0, 100.0), (50.0, 90.0)), ((100.0,),), 100.0)


def test_every_vehicle_drives_its_way_at_its_speed():
    times = table(vehicles=40, km=1.0, kmh=36.0, per_street=4)
    due = list(times.due(range(40)))
    assert [one.at_s for one in due] == sorted(one.at_s for one in due)
    assert len(due) == times.count(range(40))
    assert max(one.at_s for one in due) <= 100.0  # 1 km at 10 m/s
    by_vehicle = [[one for one in due if one.vehicle == vehicle] for vehicle in range(40)]
    assert {len(one) for one in by_vehicle} == {20, 30}  # ten streets, of either drive
    for mine in by_vehicle:
        assert [one.street for one in mine] == [(mine[0].vehicle + one.passage) % 10 for one in mine]
        assert len({one.drive for one in mine}) == 1


def test_reports_come_evenly_from_the_first_second_on():
    due = [one.at_s for one in table(vehicles=400, km=1.0, kmh=36.0).due(range(400))]
    counts, _ = np.histogram(due, 10, (0.0, 100.0))
    assert counts.min() > 0.8 * counts.mean()
    assert counts.max() < 1.2 * counts.mean()


def test_vehicles_that_share_a_street_repeat_different_drives():
    options = {"vehicles": 8, "km": 0.1, "per_street": 4}
    due = list(table(**options).due(range(8)))
    at_first = {(one.street, one.drive) for one in due if one.passage == 0 or one.passage == 1}
    assert {drive for _, drive in at_first} == {0, 1}


def test_the_seed_decides_where_they_start():
    first, again, other = (list(table(vehicles=5, seed=seed).due(range(5))) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_nothing_is_due_after_the_bound():
    assert max(one.at_s for one in table(vehicles=20, km=5.0, seconds=7.0).due(range(20))) <= 7.0


def test_settled_streets_are_reported_as_such():
    due = list(table(vehicles=40, km=1.0, changed_share=0.25).due(range(40)))
    settled = {one.street for one in due if one.report == 0 and one.drive == 0} - {3, 7}
    assert len([n for n in range(10) if LoadOptions(changed_share=0.25).is_changed(n)]) == 2
    assert {one.report for one in due if one.street in settled} == {0}


def test_all_vehicles_are_shared_out():
    assert [list(one) for one in shared_out(5, 2)] == [[0, 1], [2, 3, 4]]
    assert shared_out(1, 4) == [range(1)]


@pytest.mark.parametrize(
    "wrong", [{"vehicles": 0}, {"km": 0.0}, {"kmh": -1.0}, {"seconds": 0.0}, {"changed_share": 1.1}, {"clients": 0}]
)
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(LoadError, match=next(iter(wrong))):
        LoadOptions(**wrong)


def test_a_run_is_read_as_it_was_driven(tmp_path):
    street = read_street(make_run(tmp_path / "run"))
    assert [drive.vehicle for drive in street.drives] == ["vehicle-00", "vehicle-01"]
    assert street.length_m == LENGTH_M
    assert [report.at_m for report in street.drives[0].reports] == pytest.approx([30.0, 60.0, 90.0])
    report = street.drives[0].reports[1]
    assert isinstance(report.packed, PackedReport)
    assert report.packed.report_id == report.whole.report_id
    assert street.left_out == 0


def test_a_drive_on_another_map_is_left_out(tmp_path):
    run = make_run(tmp_path / "run")
    folder, tiles = RunFolder(run), street_tiles()
    put_vehicle(folder, "vehicle-02", tiles)
    outbox = Outbox(folder.agents / "vehicle-02" / "outbox.sqlite")
    late = against(whole_report("vehicle-02", 9, tiles[0]), b"\7" * 32)
    body = read_street(run).drives[2].reports[0].packed.encode()
    outbox.put(late.report_id, change_key("ndt", late.district), late.encode(), body)
    outbox.close()
    street = read_street(run)
    assert [drive.vehicle for drive in street.drives] == ["vehicle-00", "vehicle-01"]
    assert street.left_out == 1


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(LoadError, match="holds no run"):
        read_street(tmp_path)


def test_settled_streets_need_drives_on_them(tmp_path):
    run = make_run(tmp_path / "run")
    with pytest.raises(LoadError, match="--settled RUN"):
        Streets.of(KeptRuns(run), LoadOptions(changed_share=0.5))
