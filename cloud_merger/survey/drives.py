"""Surveys as drives: the parts put together, what they hold decoded. A part that is missing breaks the chain there."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse
from gnd.gnd_map.submap import SubmapGaussians
from gnd.schemas.survey import SurveyAnchor, SurveyFix, SurveyMotion, SurveyReport


@dataclass(frozen=True, slots=True, eq=False)
class SurveyNode:
    """One submap of a drive.

    Attributes:
        number: in the survey.
        t_ns: of its beginning.
        step: from the node before in the same chain; None at the beginning of a chain.
        gaussians: what it holds, in its own frame.
        fixes, anchors: of it.
    """

    number: int
    t_ns: int
    step: SurveyMotion | None
    gaussians: SubmapGaussians
    fixes: tuple[SurveyFix, ...]
    anchors: tuple[SurveyAnchor, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyedDrive:
    """A chain of submaps of one vehicle without a gap; a survey with missing parts makes several.

    Attributes:
        vehicle: pseudonym.
        survey_id: of the survey.
        layer: of the map.
        nodes: at least one.
    """

    vehicle: str
    survey_id: str
    layer: str
    nodes: tuple[SurveyNode, ...]

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def first_ns(self) -> int:
        """When it began."""
        return self.nodes[0].t_ns

    @property
    def last_ns(self) -> int:
        """When its last submap began."""
        return self.nodes[-1].t_ns

    def in_first(self) -> F64:
        """(N, 4, 4) poses of the nodes in the frame of the first, by odometry."""
        T = [np.eye(4)]
        for node in self.nodes[1:]:
            assert node.step is not None
            T.append(T[-1] @ node.step.T)
        return np.stack(T)


def drives_of(reports: Iterable[SurveyReport]) -> list[SurveyedDrive]:
    """The drives of all parts, by survey and part, whatever their order; a part that came twice counts once."""
    by_survey = defaultdict[str, dict[int, SurveyReport]](dict)
    for report in reports:
        by_survey[report.survey_id].setdefault(report.part, report)
    found = []
    for _, parts in sorted(by_survey.items()):
        for run in _runs(sorted(parts)):
            found += _drive([parts[number] for number in run])
    return found


def _runs(numbers: Sequence[int]) -> list[list[int]]:
    """Numbers that follow on each other, together."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def _drive(parts: Sequence[SurveyReport]) -> list[SurveyedDrive]:
    """The drives of parts that follow on each other: one, unless submaps are missing between two of them."""
    chains: list[list[SurveyNode]] = []
    for part in parts:
        for submap in part.submaps:
            follows = bool(chains) and chains[-1][-1].number + 1 == submap.number
            node = SurveyNode(
                submap.number,
                submap.t_ns,
                submap.step if follows else None,
                submap.gaussians(),
                tuple(fix for fix in part.fixes if fix.submap == submap.number),
                tuple(one for one in part.anchors if one.submap == submap.number),
            )
            if follows:
                chains[-1].append(node)
            else:
                chains.append([node])
    head = parts[0]
    return [SurveyedDrive(head.vehicle, head.survey_id, head.layer, tuple(chain)) for chain in chains]


def first_poses(drive: SurveyedDrive, frame: LocalFrame) -> F64 | None:
    """(N, 4, 4) T_frame_submap before anything is solved: by its best anchor, else its fixes; None without either.

    Without an anchor the heading is that of the fixes along the way, and level is level: the vehicle stood on a road.
    """
    T = drive.in_first()
    anchors = [(number, one) for number, node in enumerate(drive.nodes) for one in node.anchors]
    if anchors:
        number, best = min(anchors, key=lambda pair: float(np.trace(pair[1].pose.covariance[3:, 3:])))
        T_frame_submap = frame.T_self_other(LocalFrame.of_tile(best.tile)) @ best.pose.T
        return np.asarray(T_frame_submap @ T_inverse(T[number]) @ T)
    return _by_fixes(drive, frame, T)


def _by_fixes(drive: SurveyedDrive, frame: LocalFrame, T: F64) -> F64 | None:
    fixes = [(number, fix) for number, node in enumerate(drive.nodes) for fix in node.fixes]
    if len(fixes) < 2:
        return None
    driven = np.stack([T[number, :3, :3] @ fix.place_m + T[number, :3, 3] for number, fix in fixes])
    seen = np.stack([frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m) for _, fix in fixes])
    a, b = driven - driven.mean(axis=0), seen - seen.mean(axis=0)
    if np.linalg.norm(a[:, :2], axis=1).max() < 5.0:
        return None
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]).sum())
    start = np.eye(4)
    start[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    start[:3, 3] = seen.mean(axis=0) - start[:3, :3] @ driven.mean(axis=0)
    return np.asarray(start @ T)
