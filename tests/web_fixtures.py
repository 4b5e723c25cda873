"""A folder that a real web server serves, and buckets of a real S3 server; tests skip where there is none."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import pytest
from s3_server import NoS3ServerError, S3Server
from web_server import NoWebServerError, WebServer

_NUMBERS = count()
BUCKET = "tests"


@dataclass(frozen=True)
class ServedFolder:
    """What is put there can be read at the URL."""

    folder: Path
    url: str
    server: WebServer


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedFolder]:
    folder = tmp_path / "site"
    folder.mkdir()
    try:
        server = WebServer(folder, tmp_path / "web")
    except NoWebServerError as error:
        pytest.skip(str(error))
    yield ServedFolder(folder, server.url, server)
    server.end()


@pytest.fixture(scope="session")
def s3_server() -> Iterator[S3Server]:
    pytest.importorskip("obstore", reason="pip install 'gnd-fleet[objects]'")
    try:
        server = S3Server()
    except NoS3ServerError as error:
        pytest.skip(str(error))
    server.make_bucket(BUCKET)
    yield server
    server.end()


@pytest.fixture
def new_bucket(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Callable[[], str]:
    """Gives locations where nothing lies in a bucket, which the environment leads to."""
    for name, value in s3_server.environment.items():
        monkeypatch.setenv(name, value)

    def make() -> str:
        return f"s3://{BUCKET}/map{next(_NUMBERS)}"  # each bucket of its own would take the server a file of volumes

    return make
