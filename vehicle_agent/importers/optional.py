"""Libraries that only one format needs: imported when it is met, and named with their extra where they are missing."""

from importlib import import_module
from typing import Any

from gnd.extras import MissingExtra


def library(name: str, extra: str) -> Any:
    """The module `name`.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or name).split(".")[0]
        raise MissingExtra(f"{missing} is not installed; it comes with: pip install 'gnd-fleet[{extra}]'") from error
