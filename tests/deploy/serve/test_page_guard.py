"""Who may see the page: this machine alone, or whoever brings the token; and a browser that does not keep up."""

import asyncio
import http.client
import json
import shutil
import ssl
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner
from page_testing import live_street, served

from gnd.deploy.errors import ServeError
from gnd.deploy.serve.browsers import MOST_BROWSERS, QUEUED, RELOAD, BrowserHub
from gnd.deploy.serve.command import PageSource, serve
from gnd.deploy.serve.guard import PageAddress, token_of

TOKEN = "0123456789abcdef0123456789abcdef"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7", "map.example"])
def test_beyond_this_machine_a_token_and_a_certificate_are_needed(host: str, tmp_path: Path) -> None:
    with pytest.raises(ServeError, match="--token-file"):
        PageAddress(host)
    with pytest.raises(ServeError, match="--certificate"):
        PageAddress(host, token=TOKEN)
    assert PageAddress(host, token=TOKEN, certificate=tmp_path / "c", key=tmp_path / "k").url(1).startswith("https://")


def test_a_trusted_network_may_go_without_a_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GND_PLAIN_BEYOND_LOOPBACK", "1")
    assert PageAddress("0.0.0.0", token=TOKEN).url(80) == "http://0.0.0.0:80/"
    with pytest.raises(ServeError, match="--token-file"):
        PageAddress("0.0.0.0")


def test_what_is_no_address_is_refused(tmp_path: Path) -> None:
    for wrong in ({"port": 70_000}, {"token": "short"}, {"certificate": tmp_path / "c"}):
        with pytest.raises(ServeError):
            PageAddress(**wrong)
    with pytest.raises(ServeError, match="features"):
        PageSource("map.sqlite", "signs")


def test_a_token_that_others_can_read_is_none(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(TOKEN + "\n")
    path.chmod(0o644)
    with pytest.raises(ServeError, match="chmod 600"):
        token_of(path)
    path.chmod(0o600)
    assert token_of(path) == TOKEN
    with pytest.raises(ServeError, match="cannot read"):
        token_of(tmp_path / "none")


def test_the_command_refuses_before_anything_is_opened(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(serve, [str(tmp_path / "none.sqlite"), "--listen", "0.0.0.0"])
    assert isinstance(outcome.exception, ServeError)
    outcome = CliRunner().invoke(serve, [str(tmp_path / "none.sqlite"), "--port", "0"])
    assert "no such store" in str(outcome.exception)


def test_with_a_token_nothing_is_shown_without_it(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    with live_street(tmp_path, router=False) as street, served(street.path, "--token-file", str(token)) as page:
        for path in ("/", "/api/map", "/page.js"):
            assert page.get(path).status == 401
        assert page.get("/?token=" + "0" * 32).status == 401
        assert page.get(f"/api/map?token={TOKEN}").status == 401
        assert page.get("/api/map", Authorization="Bearer " + "0" * 32).status == 401
        assert page.get("/api/map", Authorization=f"Bearer {TOKEN}").status == 200
        assert page.get(f"/?token={TOKEN}", host="evil.example").status == 421
        given = page.get(f"/?token={TOKEN}")
        assert (given.status, given.headers["location"]) == (303, "/")
        cookie = given.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert page.get("/api/map", Cookie=cookie.split(";")[0]).status == 200
        assert page.get("/api/map", Cookie="gnd_page=; gnd_page=\x7f").status == 401


def test_a_browser_that_does_not_keep_up_is_told_to_reload() -> None:
    async def look_on() -> None:
        hub = BrowserHub()
        hub.begin()
        slow, quick = hub.join(), hub.join()
        assert slow is not None
        assert quick is not None
        for number in range(QUEUED + 5):
            hub.spread(json.dumps({"number": number}))
            assert json.loads(quick.get_nowait()) == {"number": number}
        assert slow.get_nowait() == RELOAD
        assert json.loads(slow.get_nowait()) == {"number": QUEUED + 1}
        hub.leave(slow)
        assert hub.count == 1

    asyncio.run(look_on())


def test_there_may_be_so_many_browsers_and_no_more() -> None:
    hub = BrowserHub()
    queues = [hub.join() for _ in range(MOST_BROWSERS)]
    assert hub.join() is None
    assert queues[0] is not None
    hub.leave(queues[0])
    assert hub.join() is not None


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_with_a_certificate_it_is_https_and_its_cookie_too(tmp_path: Path) -> None:
    token, certificate, key = (tmp_path / name for name in ("token", "cert.pem", "key.pem"))
    token.write_text(TOKEN)
    token.chmod(0o600)
    request = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost"]
    names = ["-addext", "subjectAltName=DNS:localhost", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*request, *names], check=True, capture_output=True)
    arguments = (
        "--token-file",
        str(token),
        "--certificate",
        str(certificate),
        "--key",
        str(key),
        "--name",
        "localhost",
    )
    with live_street(tmp_path, router=False) as street, served(street.path, *arguments) as page:
        assert page.url == f"https://localhost:{page.port}/"
        trusted = ssl.create_default_context(cafile=str(certificate))
        connection = http.client.HTTPSConnection("localhost", page.port, context=trusted, timeout=60)
        connection.request("GET", f"/?token={TOKEN}")
        answer = connection.getresponse()
        assert answer.status == 303
        assert "Secure" in (answer.getheader("set-cookie") or "")
        connection.close()
