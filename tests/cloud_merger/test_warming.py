"""A worker that gets its kernels ready says so: in its log before and after, and at /healthz meanwhile."""

import json
import logging
import socket
import urllib.error
import urllib.request

import pytest

from gnd.cloud_merger import warming
from gnd.fleet_bus.errors import PortInUse


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def health_of(port):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=5) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_warming_is_told_before_and_after_and_the_page_says_warming_meanwhile(monkeypatch, caplog):
    port, seen = free_port(), []
    monkeypatch.setattr(warming, "warm_up", lambda: seen.append((health_of(port), len(caplog.records))))
    with caplog.at_level(logging.INFO, logger=warming.__name__):
        warming.warmed_up("shard-7", ("127.0.0.1", port))
    (((status, told), n_before),) = seen
    assert (status, told["healthy"]) == (503, False)
    assert told["checks"]["kernels"].startswith("warming: kernels are made ready for ")
    assert n_before == 1
    before, after = (record.getMessage() for record in caplog.records)
    assert before.startswith("merger shard-7: gets its kernels ready, merges nothing until then: some seconds where")
    assert after.startswith("merger shard-7: kernels are ready after ")
    with pytest.raises(urllib.error.URLError):  # the port is free for the pages of the worker
        health_of(port)


def test_kernels_that_are_compiled_are_counted_and_told_now_and_then(monkeypatch, caplog):
    tell = []
    monkeypatch.setattr(warming, "tell_compiling", tell.append)
    monkeypatch.setattr(warming, "warm_up", lambda: [tell[0](f"kernel_{k}") for k in range(5)])
    with caplog.at_level(logging.INFO, logger=warming.__name__):
        warming.warmed_up("shard-7")
        tell[0]("one that is compiled later")
    told = [record.getMessage() for record in caplog.records]
    assert [("kernel_0 now" in one, "5 compiled" in one) for one in told] == [
        (False, False),
        (True, False),
        (False, True),
    ]


def test_a_port_that_is_taken_is_an_error(monkeypatch):
    monkeypatch.setattr(warming, "warm_up", lambda: None)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(PortInUse):
            warming.warmed_up("shard-7", taken.getsockname())
