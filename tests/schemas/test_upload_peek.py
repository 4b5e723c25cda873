"""Whose an upload is, seen on its first fields: the same as its whole head says, and nothing of what is no upload."""

import random

import pytest

from gnd.deploy.chaos.street import read_street
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.packed import PackedGaussians
from gnd.schemas.upload_head import head_of_upload
from gnd.schemas.upload_peek import peek_upload


@pytest.fixture(scope="module")
def sent():
    return read_street().said(1, "car-7", 3)


def test_it_says_what_the_head_says(sent):
    for body in (sent.packed.encode(), sent.whole.encode()):
        assert peek_upload(body)[0] == head_of_upload(body).vehicle == "car-7"


def test_the_halves_of_a_report_have_one_id(sent):
    gaussians = PackedGaussians(sent.packed.report_id, b"x", 1).encode()
    assert peek_upload(gaussians) == ("", peek_upload(sent.packed.encode())[1])
    assert len(peek_upload(gaussians)[1]) == 16


@pytest.mark.parametrize("form", ["features", "survey"])
def test_other_forms_name_their_vehicle(form):
    message = change_report_pb2.ChangeReport(major=1)
    getattr(message, form).vehicle = "car-8"
    assert peek_upload(message.SerializeToString())[0] == "car-8"


def test_nonsense_is_nobodys_and_costs_nothing(sent):
    rng, good = random.Random(1), sent.packed.encode()
    for n in range(5000):
        body = bytearray(good[: rng.randrange(len(good))]) if n % 2 else bytearray(rng.randbytes(rng.randrange(64)))
        for _ in range(rng.randrange(4)):
            if body:
                body[rng.randrange(len(body))] = rng.randrange(256)
        vehicle, report_id = peek_upload(bytes(body))
        assert len(vehicle) <= 128
        assert len(report_id) <= 128
    assert peek_upload(b"\xff" * 1000) == ("", b"")
