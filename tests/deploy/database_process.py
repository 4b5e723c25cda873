"""The server of compose.database.yaml as a plain process: its arguments, its pg_hba.conf, its secrets as files."""

import os
import pwd
import shlex
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from parts_testing import until
from postgres_server import NoServerError, binaries

PASSWORD = "not a secret: of a test"
_SETTINGS_OF_TLS = ("ssl", "ssl_cert_file", "ssl_key_file", "ssl_min_protocol_version")


def servers() -> list[Path]:
    """Folders of initdb and postgres; those with TLS first."""
    found = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True), binaries()]
    there = [one for one in found if (one / "initdb").exists()]
    return sorted(there, key=lambda one: not has_tls(one))


def has_tls(folder: Path) -> bool:
    """Whether a server was built with TLS; that of the package is not."""
    return b"libssl.so" in (folder / "postgres").read_bytes()


def self_signed(folder: Path, host: str) -> None:
    """database.key and database.crt, by the command of docs/how_to/deploy.md."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "how_to" / "deploy.md").read_text()
    line = next(line for line in page.replace("\\\n", "").splitlines() if line.startswith("openssl req"))
    words = shlex.split(line.replace("db.example", host).replace("secrets/", f"{folder}/"))
    subprocess.run(words, check=True, capture_output=True)


class DatabaseProcess:
    """The running database of a fleet.

    Args:
        service: `database` of compose.database.yaml, resolved.
        secrets: folder of database_password, database.key and database.crt.
        port: at the loopback interface.
    """

    def __init__(self, service: dict[str, Any], secrets: Path, port: int) -> None:
        self.bin = servers()[0]
        self.has_tls = has_tls(self.bin)
        self.port = port
        self._root = Path(tempfile.mkdtemp(prefix="gnd-db-"))
        shutil.copytree(secrets, self._root / "secrets")
        hba = next(one["source"] for one in service["volumes"] if one["target"] == "/etc/postgresql/pg_hba.conf")
        allowed = Path(hba).read_text()
        (self._root / "pg_hba.conf").write_text(allowed if self.has_tls else allowed.replace("hostssl", "host   "))
        self._own()
        self._initdb(service["environment"])
        self._process = self._start(service["command"])
        until("the database answers", lambda: self._is_ready(service["healthcheck"]["test"]), 60.0)

    def client(self, folder: Path) -> dict[str, str]:
        """The environment of who connects, as manifests set it: files in `folder`, TLS where the server has it."""
        service = f"[gnd]\nhost=localhost\nport={self.port}\ndbname=gnd\nuser=gnd\npassword={PASSWORD}\n"
        (folder / "pg_service.conf").write_text(service)
        return {} if self.has_tls else {"PGSSLMODE": "disable"}

    def end(self) -> None:
        """As the container is stopped."""
        self._process.send_signal(signal.SIGINT)
        self._process.wait(60)
        shutil.rmtree(self._root, ignore_errors=True)

    def _initdb(self, environment: Mapping[str, str]) -> None:
        password = environment["POSTGRES_PASSWORD_FILE"].replace("/run/secrets", str(self._root / "secrets"))
        words = ["-D", str(self._root / "data"), "-U", environment["POSTGRES_USER"], f"--pwfile={password}", "-N"]
        done = self._run("initdb", *words, *shlex.split(environment["POSTGRES_INITDB_ARGS"]))
        if done.returncode:
            raise NoServerError(f"initdb: {done.stderr[-500:]}")

    def _start(self, command: list[str]) -> subprocess.Popen[bytes]:
        words = [word.replace("/run/secrets", str(self._root / "secrets")) for word in command]
        words = [word.replace("/etc/postgresql", str(self._root)) for word in words]
        settings = [word for flag, word in zip(words[1::2], words[2::2], strict=True) if flag == "-c"]
        assert len(settings) * 2 + 1 == len(words), f"not only settings: {words}"
        if not self.has_tls:
            settings = [one for one in settings if one.split("=")[0] not in _SETTINGS_OF_TLS]
        settings += [f"port={self.port}", "listen_addresses=localhost", f"unix_socket_directories={self._root}"]
        arguments = [word for one in settings for word in ("-c", one)]
        log = (self._root / "log").open("ab")
        process = subprocess.Popen(
            [self.bin / "postgres", "-D", self._root / "data", *arguments], stdout=log, stderr=log, **self._as_user()
        )
        log.close()
        return process

    def _is_ready(self, test: list[str]) -> bool:
        """Whether the container's health check says so; makes the database as the image does."""
        assert self._process.poll() is None, (self._root / "log").read_text()[-2000:]
        words = [word.replace("/run/postgresql", str(self._root)) for word in test[2:]]
        assert test[:2] == ["CMD", "pg_isready"]
        tool = self.bin if (self.bin / "pg_isready").exists() else binaries()
        asked = subprocess.run([tool / "pg_isready", *words, f"--port={self.port}"], capture_output=True, text=True)
        return asked.returncode == 0 and self._made()

    def _made(self) -> bool:
        import psycopg

        of_owner = f"host={self._root} port={self.port} user=gnd password='{PASSWORD}' dbname=postgres"
        with psycopg.connect(of_owner, autocommit=True) as owner:
            if not owner.execute("SELECT 1 FROM pg_database WHERE datname = 'gnd'").fetchall():
                owner.execute("CREATE DATABASE gnd")
        return True

    def _run(self, program: str, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([self.bin / program, *words], capture_output=True, text=True, **self._as_user())

    def _own(self) -> None:
        self._root.chmod(0o755)
        for path in (self._root / "secrets").iterdir():
            path.chmod(0o600)
        if user := self._as_user():
            for path in (self._root, *self._root.rglob("*")):
                os.chown(path, user["user"], user["group"])

    def _as_user(self) -> dict[str, Any]:
        if os.geteuid() != 0:
            return {}
        names = {one.pw_name for one in pwd.getpwall()}
        who = pwd.getpwnam("postgres" if "postgres" in names else "nobody")
        return {"user": who.pw_uid, "group": who.pw_gid, "extra_groups": [], "cwd": "/"}
