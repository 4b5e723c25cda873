"""The result of a run: one JSON object, three pictures, and a few lines for people."""

import json
from dataclasses import dataclass
from typing import Any

from deploy.run_folder import RunFolder

PERCENTILE = 95


@dataclass(frozen=True, slots=True)
class AgentResults:
    """The result files of all agents of a run.

    Attributes:
        results: one decoded `result.json` a vehicle.
    """

    results: tuple[dict[str, Any], ...]

    @classmethod
    def read(cls, folder: RunFolder) -> "AgentResults":
        """Read the result of every vehicle that left one."""
        files = sorted(folder.agents.glob("*/result.json"))
        return cls(tuple(json.loads(path.read_text(encoding="utf-8")) for path in files))

    def total(self, key: str) -> float:
        """Return the sum of a number over the vehicles."""
        return sum(result[key] for result in self.results)
