"""Each benchmark that has options of its own takes them when it is named alone."""

import importlib

import pytest
from click.testing import CliRunner

from studies.__main__ import NAMES, alone

WITH_OPTIONS = {
    "poles": "--sensors",
    "flooder": "--kinds",
    "dearest": "--seconds",
    "many-tiles": "--tiles",
    "router-loss": "--kills",
    "district-move": "--tiles",
    "endings": "--cases",
    "page": "--gaussians",
}


@pytest.mark.parametrize("name", NAMES)
def test_options_stand_in_the_help_and_unknown_ones_are_refused(name: str) -> None:
    module = importlib.import_module(f"studies.{name.replace('-', '_')}")
    assert hasattr(module, "OPTIONS") == (name in WITH_OPTIONS)
    shown = CliRunner().invoke(alone(name), ["--help"]).output
    assert "--json" in shown
    assert WITH_OPTIONS.get(name, "--json") in shown
    assert CliRunner().invoke(alone(name), ["--no-such-option"]).exit_code == 2
