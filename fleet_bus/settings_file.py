"""Settings from a file, the environment and the command line: what the commands share.

Precedence, the later one wins: defaults, file (--config), environment (GND_AGENT__REPORT__LONGEST_S=30), --set, options
of the command.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from gnd.gnd_map.bounded import toml_table
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.settings import from_settings, merged, of_changes, of_environment, settings_sha256, settings_text

T = TypeVar("T")
SETTINGS_FILE: Final = "settings.toml"
"""Beside every result: the effective settings."""


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        ConfigError: it cannot be read, or is no TOML.
    """
    try:
        return toml_table(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is no valid TOML: {error}") from error


def layers_of(
    cls: type[Any],
    name: str,
    file: Path | None,
    changes: Sequence[str],
    options: Mapping[str, Any],
    environment: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """What file, environment, --set and options say together, as a nested mapping.

    Args:
        cls: the dataclass of the settings.
        name: of the program: "agent" reads the variables GND_AGENT__...
        file: TOML, or None.
        changes: of --set.
        options: of the command, nested by group; None means not given.
        environment: None: of this process.

    Raises:
        ConfigError: a file that cannot be read, or a name that is no setting.
    """
    variables = os.environ if environment is None else environment
    return merged(
        {} if file is None else read_toml(file),
        of_environment(cls, f"GND_{name.upper()}", variables),
        of_changes(cls, changes),
        _given(options),
    )


def load_settings(
    cls: type[T],
    name: str,
    file: Path | None,
    changes: Sequence[str],
    options: Mapping[str, Any],
    environment: Mapping[str, str] | None = None,
) -> T:
    """The effective settings of a command; arguments as of `layers_of`.

    Raises:
        ConfigError: an unknown setting (with near names), or a value that is refused.
    """
    return from_settings(
        cls, layers_of(cls, name, file, changes, options, environment), where=name if file is None else str(file)
    )


def write_settings(config: object, folder: Path) -> str:
    """Write the effective settings into a folder of results; gives their SHA-256 in hex."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / SETTINGS_FILE).write_text(settings_text(config), encoding="utf-8")
    return settings_sha256(config)


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options without those that were not given, group by group."""
    found = {name: _given(value) if isinstance(value, Mapping) else value for name, value in options.items()}
    return {name: value for name, value in found.items() if value is not None and value != {}}
