"""Libraries that only the extra `export` brings."""

import importlib
from typing import Any

from gnd.extras import MissingExtra


def library(name: str) -> Any:
    """The module of this name; MissingExtra, which says what to install, where it is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{error.name} is not installed; it comes with: pip install 'gnd-fleet[export]'") from error
