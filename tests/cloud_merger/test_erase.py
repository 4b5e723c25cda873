"""`gnd map erase`: the map and its versions stay to the bit, the name and what links its reports are gone."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import zlib

import apsw
import pytest
import zstandard
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from merger_world import BALL, POLE, TILE, WALL_AGAIN, change_of, gaussians_of, report_id, report_of
from test_feature_memory import EXIST, found, seen
from test_feature_memory import Cloud as FeatureCloud
from test_windows import BASE, EVERYTHING, Cloud, crowd
from ulid import ULID

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.erase import erase_vehicle, new_ids
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.work import Worker
from gnd.deploy.map_cli import map_group
from gnd.schemas.changes import ChangeReport
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.uploads import Upload

ANNA = "anna-s-car"
HOUR_NS = 3_600_000_000_000


def everything(path):
    """All that a store's file holds: its bytes, and what its blobs unpack to."""
    read = [one.read_bytes() for one in path.parent.glob(path.name + "*")]
    connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
    for (table,) in list(connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")):
        for row in connection.execute(f"SELECT * FROM {table}"):  # of the file's own schema
            read += [unpacked(value) for value in row if isinstance(value, bytes)]
    connection.close()
    return b"\n".join(read)


def unpacked(blob):
    for way in (zlib.decompress, zstandard.ZstdDecompressor().decompress):
        try:
            return way(blob)
        except (zlib.error, zstandard.ZstdError):
            continue
    return blob


def shas(store, layer="ndt"):
    return [(one.version, one.kind, one.sha) for one in store.history(layer, TILE)]


def call(path, *arguments):
    result = CliRunner().invoke(map_group, ["erase", str(path), *arguments])
    assert not result.exception or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.fixture
def cloud(tmp_path):
    made = Cloud(tmp_path / "map.sqlite")
    made.config = ShardConfig(store_path=made.store.path)  # what the command takes for granted
    yield made
    made.store.close()


def busy(cloud):
    """Three windows with others, of which the first two are folded; one version rests on her word among others'."""
    stale = gaussians_of(BASE)
    for n in range(3):
        cloud.sees([*crowd(2, f"day{n}"), ANNA], {3: BALL, 4: BALL, 5: BALL}, base=stale, later_s=300)
        cloud.sees([ANNA, *crowd(3, f"night{n}")], {n: None}, observed=[n], later_s=4000)
    cloud.sees(crowd(2, "late"), later_s=100)


def test_the_versions_stay_and_the_name_goes(cloud):
    busy(cloud)
    before, statuses = shas(cloud.store), cloud.verified()
    assert ANNA.encode() in everything(cloud.store.path)
    assert statuses.count("same") >= 2
    told = json.loads(call(cloud.store.path, f"vehicle:{ANNA}", "--json").stdout)["vehicles"]
    assert [(one["vehicle"], one["counts"]) for one in told] == [(ANNA, True)]
    assert [(one["reports"], one["versions"]) for one in told[0]["tiles"]] == [(6, statuses.count("same"))]
    assert shas(cloud.store) == before
    with SqliteStore(cloud.store.path) as again:
        names = {row.vehicle for row in again.reports("ndt")}
    assert ANNA not in names
    assert sum(name.startswith("gone-") for name in names) == 1
    cloud.store.close()
    assert ANNA.encode() not in everything(cloud.store.path)
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    assert cloud.verified() == statuses
    assert cloud.state() is None or all(one.vehicle != ANNA for one in cloud.state().memory.witnesses)


def test_the_map_lives_on(cloud):
    busy(cloud)
    call(cloud.store.path, f"vehicle:{ANNA}")
    cloud.store.close()
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    cloud.sees([*crowd(8, "new")], {2: None}, later_s=3000)
    assert 2 not in cloud.ids()
    assert set(cloud.verified()) == {"given", "same"}


def test_ids_and_times_tell_no_trip(cloud):
    busy(cloud)
    old = {row.report_id for row in cloud.store.reports("ndt", ANNA)}
    (told,) = json.loads(call(cloud.store.path, f"vehicle:{ANNA}", "--json").stdout)["vehicles"][0]["tiles"]
    step_ns = {"hour": HOUR_NS, "minute": 60_000_000_000, "exact": 1}[told["times"]]
    with SqliteStore(cloud.store.path) as store:
        rows = [row for row in store.reports("ndt") if row.vehicle.startswith("gone-")]
        cited = {one for version, *_ in shas(store) for one in store.provenance("ndt", TILE, version)}
        assert cited <= {row.report_id for row in store.reports("ndt")}
    assert {row.report_id for row in rows}.isdisjoint(old)
    for row in rows:
        report = ChangeReport.decode(row.body)
        assert (report.vehicle, report.report_id, report.software) == (row.vehicle, row.report_id, "-")
        assert report.course is None
        assert {report.first_ns % step_ns, report.last_ns % step_ns, row.received_ns % step_ns} == {0}


def test_dry_run_and_nobody_change_nothing(cloud):
    busy(cloud)
    before = [(row.report_id, row.vehicle, row.body) for row in cloud.store.reports("ndt")]
    assert "would be made nobody's" in call(cloud.store.path, f"vehicle:{ANNA}", "--dry-run").output
    nobody = json.loads(call(cloud.store.path, "vehicle:who", "--json").stdout)["vehicles"][0]
    assert (nobody["tiles"], sum(nobody["removed"].values())) == ([], 0)
    assert [(row.report_id, row.vehicle, row.body) for row in cloud.store.reports("ndt")] == before


def test_a_name_without_its_prefix_is_refused(cloud):
    result = CliRunner().invoke(map_group, ["erase", str(cloud.store.path), ANNA])
    assert "write vehicle:NAME" in str(result.exception)


def test_no_merger_may_work_on_the_store(cloud):
    cloud.store.join("merger-7")
    with pytest.raises(MergerError, match="merger-7 works on"):
        erase_vehicle(cloud.store, cloud.config, ANNA)


def test_raw_messages_and_refused_ones_go_too(cloud):
    report = report_of(5, change_of(gaussians_of(BASE), [1], {}), vehicle=ANNA)
    cloud.store.put_upload(Upload("k", report.encode(), report.report_id, ANNA, "whole", 1), "s")
    cloud.store.quarantine(b"broken " + ANNA.encode(), f"of {ANNA}", source="k")
    removed = json.loads(call(cloud.store.path, f"vehicle:{ANNA}", "--json").stdout)["vehicles"][0]["removed"]
    assert (removed["uploads"], removed["quarantined_messages"]) == (1, 1)
    cloud.store.close()
    assert ANNA.encode() not in everything(cloud.store.path)


def test_who_does_not_count_goes_on_not_to(cloud):
    stale = gaussians_of(BASE)
    cloud.sees([ANNA], {7: POLE, 8: POLE}, base=stale, observed=[7])
    cloud.sees(crowd(3), {3: BALL}, base=stale)
    cloud.store.quarantine_vehicle(ANNA, "lies")
    cloud.merges()
    before, ids, statuses = shas(cloud.store), cloud.ids(), cloud.verified()
    told = json.loads(call(cloud.store.path, f"vehicle:{ANNA}", "--json").stdout)["vehicles"][0]
    assert not told["counts"]
    cloud.store.close()
    assert ANNA.encode() not in everything(cloud.store.path)
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    assert (shas(cloud.store), cloud.verified()) == (before, statuses)
    cloud.sees(crowd(2, "new"), later_s=4000)
    assert cloud.ids() == ids
    assert set(cloud.verified()) == {"given", "same"}


def reopened(cloud):
    """The same cloud of features on the store as it is now."""
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    cloud.inbox = FeatureInbox(cloud.store, cloud.config.features, (), reach_tiles=3)
    cloud.worker = Worker(cloud.store, cloud.config)


def test_features_stay_and_the_name_goes(tmp_path):
    cloud = FeatureCloud(tmp_path / "map.sqlite")
    said = [seen(7, EXIST, (-5.0, 3.1)), seen(9), found(2.0, 2.0)]
    for n in range(4):
        cloud.sees([*crowd(2, f"day{n}"), ANNA], *said, later_s=900)
    before = [(one.version, one.sha) for one in cloud.store.history("signs", TILE)]
    statuses = cloud.verified()
    assert statuses.count("same") >= 2
    cloud.store.close()
    assert ANNA.encode() in everything(cloud.store.path)
    assert json.loads(call(cloud.store.path, f"vehicle:{ANNA}", "--json").stdout)["vehicles"][0]["tiles"]
    assert ANNA.encode() not in everything(cloud.store.path)
    reopened(cloud)
    assert [(one.version, one.sha) for one in cloud.store.history("signs", TILE)] == before
    assert cloud.verified() == statuses
    cloud.sees(crowd(3, "new"), *said, later_s=4000)
    assert set(cloud.verified()) == {"given", "same"}
    cloud.store.close()


KILLED = """
    import os, signal, sys
    from pathlib import Path
    from gnd.cloud_merger import erase
    from gnd.cloud_merger.config import ShardConfig
    from gnd.tile_store.sqlite_store import SqliteStore
    path = Path(sys.argv[1])
    with SqliteStore(path) as store:
        erase.erase_vehicle(store, ShardConfig(store_path=path), sys.argv[2],
                            lambda *_: os.kill(os.getpid(), signal.SIGKILL))
"""


def test_killed_on_the_way_it_is_begun_again(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite")
    busy(cloud)
    cloud.store.put_upload(Upload("k", b"raw " + ANNA.encode(), report_id(5), ANNA, "whole", 1), "s")
    before, statuses = shas(cloud.store), cloud.verified()
    cloud.store.close()
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(cloud.store.path), ANNA], check=False, env=dict(os.environ)
    )
    assert done.returncode == -signal.SIGKILL
    assert ANNA.encode() in everything(cloud.store.path), "the tile is done, the rest is not"
    call(cloud.store.path, f"vehicle:{ANNA}")
    assert ANNA.encode() not in everything(cloud.store.path)
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    cloud.config = ShardConfig(store_path=cloud.store.path)
    assert shas(cloud.store) == before
    assert len(statuses) == len(cloud.verified())
    cloud.store.close()


ids = st.integers(0, (1 << 128) - 1).map(lambda n: str(ULID(n.to_bytes(16, "big"))))


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine is no finding
@given(st.sets(ids, min_size=1, max_size=12), st.data())
def test_new_ids_keep_the_order_of_all(all_ids, data):
    own = set(data.draw(st.lists(st.sampled_from(sorted(all_ids)), min_size=1, unique=True)))
    made = new_ids(sorted(all_ids), own)
    assert made.keys() == own
    after = [made.get(one, one) for one in sorted(all_ids)]
    assert after == sorted(after)
    assert len(set(after)) == len(all_ids)


@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_history_verifies_after_it(tmp_path_factory, data):
    """Vehicles that agree and contradict, in windows as they fall; she is one of three."""
    cloud = Cloud(tmp_path_factory.mktemp("store") / "map.sqlite", window_reports=data.draw(st.integers(2, 6)))
    cloud.config = ShardConfig(store_path=cloud.store.path)
    words = st.sampled_from([{}, {3: BALL}, {1: None}, {1: WALL_AGAIN}, {3: POLE, 1: None}])
    for _ in range(data.draw(st.integers(4, 14))):
        who = data.draw(st.sampled_from([ANNA, "b", "c"]))
        seen_ids = data.draw(st.sampled_from([EVERYTHING, [0, 1], [3, 4]]))
        cloud.sees([who], data.draw(words), observed=seen_ids, later_s=data.draw(st.sampled_from([1.0, 400.0, 5000.0])))
    before, statuses = shas(cloud.store), cloud.verified()
    call(cloud.store.path, f"vehicle:{ANNA}")
    cloud.store.close()
    cloud.store = SqliteStore(cloud.store.path, cloud.store._config, now_ns=lambda: cloud.now_ns)
    assert (shas(cloud.store), cloud.verified()) == (before, statuses)
    cloud.sees(["b", "d", "e"], {4: BALL}, later_s=4000)
    assert [one for one in cloud.verified() if one == "differs"] == []
    cloud.store.close()
