"""Alert rules and dashboard: each expression is PromQL, each alert is explained. `test_deployments_run` asks a running
fleet for the metrics in them.
"""

import re
import shutil
import subprocess
from itertools import combinations, product

import pytest
import yaml
from manifests import DEPLOY, compose
from metric_names import MONITORING, asked, of_alerts, of_dashboard, panels, rules

OPERATIONS = (DEPLOY.parent / "docs" / "operations.md").read_text()
of_prometheus = pytest.mark.skipif(shutil.which("promtool") is None, reason="apt-get install prometheus")


def test_every_expression_can_be_read_and_a_wrong_one_cannot() -> None:
    assert {name for _, name, _ in of_alerts()} >= {"gnd_queue_overdue_seconds", "gnd_shard_alive", "up"}
    assert len(of_dashboard()) > 20
    with pytest.raises(ValueError, match="unclosed left parenthesis"):
        asked("sum by (job (gnd_tiles)")
    assert asked("max by (job) (rate(a{b='c'}[5m])) > 2 * d")[0][1:] == ("a", {"job", "b"})


def test_every_alert_says_how_bad_it_is_and_waits_before_it_does() -> None:
    names = [rule["alert"] for rule in rules()]
    assert len(set(names)) == len(names) > 10
    for rule in rules():
        assert set(rule) == {"alert", "expr", "for", "labels", "annotations"}
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert re.fullmatch(r"\d+[mh]", rule["for"])
        assert rule["annotations"]["summary"]
        grouped = re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])
        for label in grouped:  # a label that a sum has taken away would be shown as nothing
            sums = re.findall(r"by \(([^)]*)\)", rule["expr"].partition(" and on ")[0])
            assert not sums or any(label in one.split(", ") for one in sums), rule["alert"]


def test_every_alert_is_explained_with_what_to_do() -> None:
    rows = re.findall(r"^\| `(Gnd\w+)` \| (.+) \| (.+) \|$", OPERATIONS, re.M)
    assert sorted(name for name, _, _ in rows) == sorted(rule["alert"] for rule in rules())
    assert all(len(what) > 20 for _, _, what in rows)


def test_the_dashboard_has_panels_that_do_not_overlap_and_each_asks_something() -> None:
    found = panels()
    assert len({panel["id"] for panel in found}) == len(found)
    places = []
    for panel in found:
        at = panel["gridPos"]
        assert at["x"] + at["w"] <= 24
        places.append(set(product(range(at["x"], at["x"] + at["w"]), range(at["y"], at["y"] + at["h"]))))
        if panel["type"] == "row":
            continue
        assert panel["title"]
        assert {target["datasource"]["uid"] for target in panel["targets"]} == {"${source}"}
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"]) > 0
    assert not any(one & other for one, other in combinations(places, 2))


def test_prometheus_asks_at_the_ports_that_compose_opens() -> None:
    read = yaml.safe_load((MONITORING / "prometheus.yaml").read_text())
    targets = read["scrape_configs"][0]["static_configs"][0]["targets"]
    services = compose("compose.cloud.yaml")["services"].values()
    opened = {port["published"] for one in services for port in one.get("ports", []) if port["target"] == 9100}
    assert {target.partition(":")[2] for target in targets} == opened
    for name in ("prometheus.yaml", "prometheus-kubernetes.yaml"):
        (job,) = yaml.safe_load((MONITORING / name).read_text())["scrape_configs"]
        assert job["job_name"] == "gnd"  # alerts ask for it


@of_prometheus
def test_promtool_takes_rules_and_settings() -> None:
    for words in (["rules", "alerts.yaml"], ["config", "--syntax-only", "prometheus.yaml"]):
        done = subprocess.run(["promtool", "check", *words], cwd=MONITORING, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@of_prometheus
def test_alerts_are_raised_by_what_they_are_for_and_by_nothing_else() -> None:
    words = ["promtool", "test", "rules", "alerts_test.yaml"]
    done = subprocess.run(words, cwd=MONITORING, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
