"""The settings of an agent from file, environment, --set and options."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gnd.fleet_bus.settings_file import layers_of
from gnd.gnd_map.config import to_mapping
from gnd.gnd_map.settings import from_settings, merged, plain_settings
from gnd.schemas.feature_layer import declared_layers, named_layer
from gnd.vehicle_agent.config import DEFAULT_NAME, AgentConfig
from gnd.vehicle_agent.detect.parameters import DetectParameters


def load_agent(
    file: Path | None,
    changes: Sequence[str],
    options: Mapping[str, Any],
    environment: Mapping[str, str] | None = None,
) -> AgentConfig:
    """The effective settings of an agent.

    Args:
        file: TOML, or None.
        changes: NAME=VALUE, as of --set.
        options: nested by group; None means not given.
        environment: None: of this process (GND_AGENT__REPORT__LONGEST_S=30).

    Raises:
        ConfigError: an unknown setting (with near names), one that is missing, or a value of the wrong type.
        GndError: a value out of its range.
    """
    given = layers_of(AgentConfig, "agent", file, changes, options, environment)
    return agent_of(given, where="agent" if file is None else str(file))


def agent_of(given: Mapping[str, Any], *, where: str = "agent") -> AgentConfig:
    """An agent with the given settings; the mode of detection chooses the defaults of detection.

    Args:
        given: nested mapping; `features.layers` may hold names of known or declared layers instead of tables.
        where: they come from, for messages.

    Raises:
        ConfigError: as of `load_agent`.
        LayerError: a layer that nobody has declared.
    """
    values = merged({"vehicle": DEFAULT_NAME, "drive": None}, _defaults_of_mode(given), given)
    values.setdefault("work_dir", f"runs/{values['vehicle']}")
    features = values.get("features")
    if isinstance(features, Mapping) and isinstance(layers := features.get("layers"), list | tuple):
        declared = declared_layers(values.get("feature_layer", []), where)
        tables = [to_mapping(named_layer(one, declared)) if isinstance(one, str) else one for one in layers]
        values["features"] = {**features, "layers": tables}
    return from_settings(AgentConfig, values, where=where)


def _defaults_of_mode(given: Mapping[str, Any]) -> dict[str, Any]:
    detect = given.get("detect")
    if isinstance(detect, Mapping) and detect.get("mode") == "paper":
        return {"detect": plain_settings(DetectParameters.paper())}
    return {}
