"""The parameters of the method under test: a mode's own, with single fields replaced (`--set detect.new_cells=30`)."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from gnd.cloud_merger.merge import MergeParameters
from gnd.gnd_map.config import from_mapping, to_mapping
from gnd.gnd_map.errors import GndError
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.simulation.errors import OptionError

Mode = Literal["default", "paper"]


@dataclass(frozen=True, slots=True)
class MethodParameters:
    """Everything that decides what vehicles report and what the cloud makes of it."""

    localise: LocaliserParameters = field(default_factory=LocaliserParameters)
    segment: SegmentParameters = field(default_factory=SegmentParameters)
    detect: DetectParameters = field(default_factory=DetectParameters)
    report: ReportParameters = field(default_factory=ReportParameters)
    merge: MergeParameters = field(default_factory=MergeParameters)

    @classmethod
    def of_mode(cls, mode: Mode) -> "MethodParameters":
        """Return the parameters of a mode; movers are segmented in both, as in the paper ([50])."""
        if mode == "paper":
            return cls(detect=DetectParameters.paper(), merge=MergeParameters(mode="paper", eps=0.5))
        return cls()

    def with_changes(self, changes: Iterable[str]) -> "MethodParameters":
        """Return these parameters with fields replaced.

        Args:
            changes: such as "detect.new_cells=30" or "detect.masses.lambda_c_pass=0.04"; values as in JSON, words
                without quotes.

        Raises:
            OptionError: no such field, or a value that it refuses.
        """
        plain = to_mapping(self)
        for change in changes:
            _replace(plain, change)
        try:
            return from_mapping(MethodParameters, plain)
        except GndError as error:
            raise OptionError(f"--set: {error}") from error


def _replace(plain: dict[str, Any], change: str) -> None:
    path, equals, text = change.partition("=")
    *groups, name = path.strip().split(".")
    if not equals or not groups:
        raise OptionError(f"--set takes GROUP.FIELD=VALUE, such as detect.new_cells=30, got {change!r}")
    table: Any = plain
    for group in groups:
        table = table.get(group) if isinstance(table, dict) else None
    if not isinstance(table, dict) or name not in table:
        known = (
            ", ".join(sorted(table)) if isinstance(table, dict) else ", ".join(f.name for f in fields(MethodParameters))
        )
        raise OptionError(f"--set: there is no parameter {path.strip()!r}; known here: {known}")
    table[name] = _value(text.strip())


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
