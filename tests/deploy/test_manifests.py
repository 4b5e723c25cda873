"""Compose files and Kubernetes manifests are what their tools take, hardened, and say nothing that is not there."""

import copy
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from manifests import COMPOSE, DEPLOY, HOST, OVERLAYS, compose, docker_compose, kustomized, of_kind, pods

Objects = tuple[dict[str, Any], ...]
PAGE = DEPLOY.parent / "docs" / "how_to" / "deploy.md"
COMPONENT = "app.kubernetes.io/component"
KEDA = {
    "": {"scaleTargetRef", "pollingInterval", "minReplicaCount", "maxReplicaCount", "advanced", "triggers"},
    "scaleTargetRef": {"apiVersion", "kind", "name"},
    "advanced": {"horizontalPodAutoscalerConfig"},
    "trigger": {"type", "metricType", "metadata"},
    "prometheus": {"serverAddress", "query", "threshold"},
}
"""What we use of ScaledObject (keda.sh/v1alpha1), of which no package has the schema."""


@pytest.fixture(params=OVERLAYS)
def objects(request: pytest.FixtureRequest) -> Objects:
    return kustomized(request.param)


def check(one: dict[str, Any]) -> None:
    """ValidationError where the API of Kubernetes would not take an object, or has no such key."""
    validator = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate")
    validator.validate(one, "1.37", strict=True)


@pytest.mark.parametrize("name", COMPOSE)
def test_docker_compose_takes_the_file(name: str) -> None:
    assert compose(name)["services"]


def test_docker_compose_refuses_what_is_misspelt(tmp_path: Path) -> None:
    text = (DEPLOY / "compose.cloud.yaml").read_text()
    (tmp_path / "bad.yaml").write_text(text.replace("start_period:", "start_periode:"))
    words = [docker_compose(), "-f", str(tmp_path / "bad.yaml"), "config", "--quiet"]
    done = subprocess.run(words, env=HOST, capture_output=True, text=True)
    assert done.returncode != 0
    assert "start_periode" in done.stderr


def test_a_host_must_be_told_who_it_is() -> None:
    words = [docker_compose(), "-f", str(DEPLOY / "compose.cloud.yaml"), "config", "--quiet"]
    done = subprocess.run(words, env={}, capture_output=True, text=True)
    assert done.returncode != 0
    assert re.search("required variable (HOST|ROUTER_[AB]) is missing", done.stderr), done.stderr


@pytest.mark.parametrize("name", COMPOSE)
def test_no_container_has_more_rights_than_it_needs(name: str) -> None:
    for part, service in compose(name)["services"].items():
        assert service["user"] in ("10001:10001", "999:999"), part
        assert service["read_only"] is True, part
        assert service["cap_drop"] == ["ALL"], part
        assert service["security_opt"] == ["no-new-privileges:true"], part
        assert service["pids_limit"] > 0, part
        assert int(service["mem_limit"]) > 0, part
        assert not {"privileged", "cap_add", "network_mode", "pid", "ipc", "devices"} & set(service), part
        for port in service.get("ports", []):
            is_secure = port["target"] in (7447, 5432)  # TLS: the router has an identity, pg_hba.conf says hostssl
            assert is_secure or port["host_ip"] == "127.0.0.1", (part, port)


def test_the_database_lets_nobody_in_without_tls_and_a_password() -> None:
    lines = [line.split() for line in (DEPLOY / "database" / "pg_hba.conf").read_text().splitlines()]
    rules = [line for line in lines if line and line[0] != "#"]
    assert {line[0] for line in rules} == {"local", "hostssl"}
    assert {line[-1] for line in rules} == {"scram-sha-256"}


@pytest.mark.parametrize("name", COMPOSE)
def test_what_runs_all_the_time_has_a_health_check_and_comes_back(name: str) -> None:
    for part, service in compose(name)["services"].items():
        if not service.get("profiles"):
            assert service["healthcheck"]["test"][0] == "CMD", part
            assert service["restart"] == "unless-stopped", part


def test_secrets_are_files_that_are_not_here() -> None:
    for name in COMPOSE:
        for secret in compose(name).get("secrets", {}).values():
            assert "/secrets/" in secret["file"]
            assert not Path(secret["file"]).exists()
        for service in compose(name)["services"].values():
            variables = service.get("environment") or {}
            assert not [one for one in variables if re.search("PASSWORD$|SECRET|KEY", one)], variables


def test_kubernetes_takes_the_objects(objects: Objects) -> None:
    assert len(objects) >= 14
    for one in objects:
        if one["kind"] != "ScaledObject":
            check(one)


def test_what_is_misspelt_or_wrong_is_refused() -> None:
    validator = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate")
    shard = next(one for one in kustomized("trial") if one["kind"] == "StatefulSet")
    for key, value in (("readinesProbe", {}), ("args", "merger")):
        wrong = copy.deepcopy(shard)
        wrong["spec"]["template"]["spec"]["containers"][0][key] = value
        with pytest.raises(validator.ValidationError):
            check(wrong)


def test_the_bucket_is_a_component_that_fits(tmp_path: Path) -> None:
    overlay = yaml.safe_load((DEPLOY / "kubernetes" / "overlays" / "production" / "kustomization.yaml").read_text())
    assert overlay["components"] == ["../../components/autoscaling"]
    folder = DEPLOY / "kubernetes"
    (tmp_path / "kustomization.yaml").write_text(
        "apiVersion: kustomize.config.k8s.io/v1beta1\nkind: Kustomization\n"
        f"resources: [{os.path.relpath(folder / 'base', tmp_path)}]\n"
        f"components: [{os.path.relpath(folder / 'components/bucket', tmp_path)}]\n"
    )
    found = kustomized(str(tmp_path))
    with_bucket = {
        one["metadata"]["name"]
        for one in of_kind(found, "StatefulSet", "Deployment")
        if one["spec"]["template"]["spec"]["containers"][0].get("envFrom") == [{"secretRef": {"name": "bucket"}}]
    }
    assert with_bucket == {"shard", "tiles"}
    for one in found:
        check(one)


def test_a_scaled_object_has_the_keys_that_keda_knows() -> None:
    (one,) = of_kind(kustomized("production"), "ScaledObject")
    spec = one["spec"]
    assert set(spec) <= KEDA[""]
    for key in ("scaleTargetRef", "advanced"):
        assert set(spec[key]) <= KEDA[key]
    for trigger in spec["triggers"]:
        assert set(trigger) <= KEDA["trigger"]
        assert set(trigger["metadata"]) == KEDA["prometheus"]
        assert all(isinstance(value, str) for value in trigger["metadata"].values())
    behaviour = spec["advanced"]["horizontalPodAutoscalerConfig"]["behavior"]
    target = {"apiVersion": "apps/v1", "kind": "StatefulSet", "name": "shard"}
    scaler = {"scaleTargetRef": target, "maxReplicas": 4, "behavior": behaviour}
    check(
        {"apiVersion": "autoscaling/v2", "kind": "HorizontalPodAutoscaler", "metadata": {"name": "x"}, "spec": scaler}
    )


def test_what_is_scaled_has_no_number_of_its_own_and_an_identity_for_each() -> None:
    found = kustomized("production")
    scalers = of_kind(found, "ScaledObject", "HorizontalPodAutoscaler")
    workloads = {one["metadata"]["name"]: one for one in of_kind(found, "StatefulSet", "Deployment")}
    assert sorted(one["spec"]["scaleTargetRef"]["name"] for one in scalers) == ["shard", "tiles"]
    for one in scalers:
        target = one["spec"]["scaleTargetRef"]
        assert workloads[target["name"]]["kind"] == target["kind"]
        assert "replicas" not in workloads[target["name"]]["spec"]
    (shard,) = of_kind(found, "ScaledObject")
    assert shard["spec"]["maxReplicaCount"] == len(identities_of(workloads["shard"])) == 4


def identities_of(workload: dict[str, Any]) -> list[str]:
    volumes = workload["spec"]["template"]["spec"]["volumes"]
    sources = [source for volume in volumes for source in volume.get("projected", {}).get("sources", [])]
    return [source["secret"]["name"] for source in sources]


def test_no_pod_has_more_rights_than_it_needs(objects: Objects) -> None:
    (space,) = of_kind(objects, "Namespace")
    assert space["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"
    found = pods(objects)
    assert {name.rpartition("-")[0] for name, _ in found} == {"router", "tiles", "shard"}
    for name, pod in found:
        assert pod["automountServiceAccountToken"] is False, name
        of_pod = pod["securityContext"]
        assert of_pod["runAsNonRoot"] is True, name
        assert of_pod["runAsUser"] == of_pod["runAsGroup"] == of_pod["fsGroup"] == 10001, name
        assert of_pod["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod), name
        for container in pod["containers"]:
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
            }, name  # fmt: skip
            assert container["resources"]["limits"]["memory"], name
        for volume in pod["volumes"]:
            assert set(volume) & {"secret", "projected", "emptyDir"}, (name, volume)
            mode = volume.get("secret", volume.get("projected", {})).get("defaultMode", 0o440)
            assert mode == 0o440, (name, volume)


def test_probes_ask_pages_that_there_are(objects: Objects) -> None:
    for name, pod in pods(objects):
        (container,) = pod["containers"]
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        assert f"--metrics-port={ports['metrics']}" in container["args"], name
        asked = {kind: container[f"{kind}Probe"]["httpGet"] for kind in ("startup", "liveness", "readiness")}
        assert {one["port"] for one in asked.values()} == {"metrics"}, name
        # What a restart does not mend must not restart: /healthz asks for database, router and queue.
        assert [one["path"] for one in asked.values()] == ["/livez", "/livez", "/healthz"], name


def test_selectors_find_their_pods_and_every_part_has_a_budget(objects: Objects) -> None:
    labels = {}
    for one in of_kind(objects, "StatefulSet", "Deployment"):
        labels[one["metadata"]["name"]] = one["spec"]["template"]["metadata"]["labels"][COMPONENT]
        assert one["spec"]["selector"]["matchLabels"][COMPONENT] == labels[one["metadata"]["name"]]
    budgets = {one["spec"]["selector"]["matchLabels"][COMPONENT] for one in of_kind(objects, "PodDisruptionBudget")}
    assert budgets == set(labels.values())
    services = {one["metadata"]["name"]: one for one in of_kind(objects, "Service")}
    assert all(one["spec"]["selector"][COMPONENT] in labels.values() for one in services.values())
    for one in of_kind(objects, "StatefulSet"):
        assert services[one["spec"]["serviceName"]]["spec"]["clusterIP"] == "None"


def test_what_connects_names_a_pod_and_may_reach_it(objects: Objects) -> None:
    names = {f"{name}.router" for name, _ in pods(kustomized("production")) if name.startswith("router-")}
    for name, pod in pods(objects):
        connects = re.findall(r"--connect=tls/(\S+):7447", " ".join(pod["containers"][0]["args"]))
        assert set(connects) == names, name
    policies = {one["metadata"]["name"]: one["spec"] for one in of_kind(objects, "NetworkPolicy")}
    assert policies["nothing"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    egress = [(name, to) for name, one in policies.items() for to in one.get("egress", [])]
    reached = {(name, port["port"]) for name, to in egress for port in to["ports"]}
    assert reached == {("names", 53), ("router", 7447), ("store", 7447), ("store", 5432)}
    of_store = policies["store"]["podSelector"]["matchExpressions"]
    assert of_store == [{"key": COMPONENT, "operator": "In", "values": ["tiles", "shard"]}]


def test_secrets_are_named_and_never_contained(objects: Objects) -> None:
    assert of_kind(objects, "Secret", "ConfigMap") == []
    volumes = [volume for _, pod in pods(objects) for volume in pod["volumes"]]
    named = {volume["secret"]["secretName"] for volume in volumes if "secret" in volume}
    named |= {name for one in of_kind(objects, "StatefulSet", "Deployment") for name in identities_of(one)}
    made = set(re.findall(r"create secret generic (\S+)", PAGE.read_text()))
    assert {re.sub(r"\d+$", "$n", name) for name in named} <= made | {"identity-shard-$n", "identity-router-$n"}
    assert {"identity-shard-$n", "identity-router-$n", "identity-tiles", "database", "bucket"} <= made


def test_the_database_of_nobody_is_replaced_in_every_overlay(objects: Objects) -> None:
    assert "192.0.2.10" in (DEPLOY / "kubernetes" / "base" / "network.yaml").read_text()
    assert "192.0.2.10" not in yaml.safe_dump_all(objects)
