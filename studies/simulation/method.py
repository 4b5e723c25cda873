"""The parameters of the method under test: a mode's own, with single fields replaced (`--set detect.new_cells=30`)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from gnd.cloud_merger.merge import MergeParameters
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.settings import changed, setting
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from studies.simulation.errors import OptionError

Mode = Literal["default", "paper"]


@dataclass(frozen=True, slots=True)
class MethodParameters:
    """Everything that decides what vehicles report and what the cloud makes of it."""

    localise: LocaliserParameters = setting(LocaliserParameters, "Localisation.")
    segment: SegmentParameters = setting(SegmentParameters, "Segmentation.")
    detect: DetectParameters = setting(DetectParameters, "Detection.")
    report: ReportParameters = setting(ReportParameters, "Reports.")
    merge: MergeParameters = setting(MergeParameters, "The merge.")

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
        try:
            return changed(self, list(changes))
        except GndError as error:
            raise OptionError(str(error)) from error
