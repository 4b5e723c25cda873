"""A fleet from the very command lines of its manifests, as plain processes: hosts, ports and paths are replaced."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from manifests import Part
from parts_testing import get, until
from prometheus_client.parser import text_string_to_metric_families
from suite_ports import new_port

from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName

GND = [sys.executable, "-m", "gnd.deploy.cli"]
_ENDPOINT = re.compile(r"tls/([^:]+):7447")
_OPTION_OF_METRICS = "--metrics-"
_HEALTHY_S = 240.0  # kernels may have to be compiled


def identities(folder: Path, members: Mapping[str, MemberName]) -> None:
    """Identity folders by name, of one authority; routers know all members."""
    authority = Authority.create(folder.with_name("authority"), "tests")
    for name, member in members.items():
        hosts = ("localhost", "127.0.0.1") if member.role == "router" else ()
        authority.issue(member, folder / name, hosts=hosts)
    members_json, revoked = authority.lists()
    for name, member in members.items():
        (folder / name / "revoked.pem").write_bytes(revoked)
        if member.role == "router":
            (folder / name / "members.json").write_bytes(members_json)


@dataclass
class DeployedFleet:
    """Running processes by the names of their parts.

    Attributes:
        folder: of logs.
        environment: of all processes, over that of the manifests.
        ports: of /metrics by part.
    """

    folder: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    ports: dict[str, int] = field(default_factory=dict)
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self, part: Part, endpoints: Mapping[str, int], name: str = "") -> None:
        """Start a part.

        Args:
            part: of a manifest.
            endpoints: ports of routers by their names in it; "0.0.0.0": where this part listens.
            name: by which it is known here; "": its own.
        """
        name = name or part.name
        words = [self._outside(word, part, endpoints) for word in part.words]
        words = self._with_metrics(words, name)
        environment = {key: self._outside(value, part, endpoints) for key, value in part.environment.items()}
        self._run(name, words, environment)

    def wait_healthy(self, names: Sequence[str] = ()) -> None:
        """Wait until /healthz of all parts, or of some, says so."""
        for name in names or list(self.ports):
            port = self.ports[name]
            until(f"{name} is healthy", lambda name=name, port=port: self._is_healthy(name, port), _HEALTHY_S)
            assert get(port, "livez") == (200, "ok\n")

    def _is_healthy(self, name: str, port: int) -> bool:
        assert self.running[name].poll() is None, f"{name} has ended\n{self.logs()}"
        return get(port, "healthz")[0] == 200

    def drive(self, words: Sequence[str], result: Path) -> dict[str, object]:
        """Run an agent to its end; its result."""
        done = subprocess.run([*GND, *words], capture_output=True, text=True, env=self._all({}), timeout=240)
        assert done.returncode == 0, done.stdout + done.stderr + self.logs()
        read: dict[str, object] = json.loads(result.read_text())
        return read

    def metrics(self) -> dict[str, dict[str, set[str]]]:
        """Names of all metrics of all parts; of each the values of its labels seen now."""
        found: dict[str, dict[str, set[str]]] = {}
        for port in self.ports.values():
            for family in text_string_to_metric_families(get(port, "metrics")[1]):
                endings = {"counter": ["_total"], "histogram": ["_bucket", "_count", "_sum"]}.get(family.type, [""])
                for ending in endings:
                    found.setdefault(family.name + ending, {})
                for sample in family.samples:
                    for label, value in sample.labels.items():
                        found.setdefault(sample.name, {}).setdefault(label, set()).add(value)
        return found

    def kill(self, name: str) -> None:
        """kill -9."""
        self.running[name].kill()
        self.running.pop(name).wait()
        self.ports.pop(name, None)

    def stop(self, name: str, *, ended: str = "") -> None:
        """SIGTERM to one; or, where that may be, it has ended by itself meanwhile and said so."""
        self.running[name].terminate()
        code = self.running.pop(name).wait(30)
        has_told = bool(ended) and ended in (self.folder / f"{name}.log").read_text()
        assert code == 0 or (code == 2 and has_told), self.logs()

    def end(self) -> None:
        """SIGTERM to all; each has to end by itself."""
        for process in self.running.values():
            process.terminate()
        codes = {}
        for name, process in self.running.items():
            try:
                codes[name] = process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                codes[name] = process.wait()
        self.running.clear()
        assert set(codes.values()) <= {0}, f"{codes}\n{self.logs()}"

    def logs(self) -> str:
        """The end of each log."""
        return "\n".join(f"== {path.name}\n{path.read_text()[-2000:]}" for path in sorted(self.folder.glob("*.log")))

    def _outside(self, word: str, part: Part, endpoints: Mapping[str, int]) -> str:
        word = _ENDPOINT.sub(lambda match: f"tls/127.0.0.1:{endpoints[match[1]]}", word)
        if not part.mounts:
            return word
        inside = "|".join(re.escape(path) for path in sorted(part.mounts, key=len, reverse=True))
        return re.sub(rf"(^|=)({inside})(?=/|$)", lambda match: f"{match[1]}{part.mounts[match[2]]}", word)

    def _with_metrics(self, words: list[str], name: str) -> list[str]:
        """The same with a port of this machine's own alone; a part without metrics keeps to it."""
        joined = [
            word for pair in words for word in (pair.split("=", 1) if pair.startswith(_OPTION_OF_METRICS) else [pair])
        ]
        if "--metrics-port" not in joined:
            return joined
        self.ports[name] = new_port()
        joined[joined.index("--metrics-port") + 1] = str(self.ports[name])
        if "--metrics-host" in joined:
            joined[joined.index("--metrics-host") + 1] = "127.0.0.1"
        return joined

    def _run(self, name: str, words: Sequence[str], environment: Mapping[str, str]) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                [*GND, *words], stdout=log, stderr=log, env=self._all(environment), cwd=self.folder
            )

    def _all(self, environment: Mapping[str, str]) -> dict[str, str]:
        known = {**os.environ, **environment, **self.environment}
        return {name: value for name, value in known.items() if name != "NUMBA_CACHE_DIR"}  # kernels are there already
