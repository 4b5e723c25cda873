"""A closed window of a tile of a feature layer, folded: the state of its hypotheses, from which the next begins."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from gnd.cloud_merger.features.memory import LayerMemory, Remembered, Vote
from gnd.cloud_merger.features.merge import Hypotheses, MergedFeatures
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.publication import FEATURE_VOTERS, Story
from gnd.cloud_merger.features.rls import PlaceEstimate, estimate
from gnd.cloud_merger.features.shapes import length_of
from gnd.cloud_merger.features.tracks import FeatureTrack

VOTES_KEPT: Final = 16
"""Of a feature the votes of so many vehicles, the newest, or of as many as decide (`FeatureMergeParameters.voters`)."""
MEASURERS_KEPT: Final = 8
"""So many vehicles that measured it last stay apart; those before are one estimate."""
GONE_KEPT: Final = 256
"""Of the vehicles before those the newest so many by name: who comes back is known."""
NAMES_KEPT: Final = 8
FORGOTTEN_DAYS: Final = 180
"""What is not published and not the map's, and has been claimed by nobody for so long, is forgotten."""
MOST_LONELY: Final = 256
"""What single vehicles have found, of a tile; where it is more, who has found most loses what it found first."""


def fold(merged: MergedFeatures, parameters: FeatureMergeParameters, day: int) -> LayerMemory:
    """What a window leaves for those after it.

    Args:
        merged: the window, whole.
        parameters: with which it was merged.
        day: `gnd.gnd_map.day` of the newest receipt of its reports.
    """
    what = merged.hypotheses
    stories = [story for story in what.stories if not _is_refuted(story, parameters)]
    days = {story.track.serial: _day_of(story, day) for story in stories}
    stories = [story for story in stories if _is_kept(story) or day - days[story.track.serial] <= FORGOTTEN_DAYS]
    stories = _fair(stories)
    votes = {story.track.serial: _votes_of(story) for story in stories}
    heard = sorted({number for own in votes.values() for number, _ in own})
    cited = {vote.elsewhere for own in votes.values() for _, vote in own}
    witness = {number: k for k, number in enumerate(heard)}
    apart = _apart([story.track for story in stories], parameters.reach_m)
    tracks = []
    for k, story in enumerate(stories):
        serial = story.track.serial
        kept_votes = tuple((witness[number], vote) for number, vote in votes[serial])
        names = _names(what, story, cited)
        tracks.append(_remembered(story, kept_votes, names, apart.get(k, frozenset()), days[serial]))
    return LayerMemory(tuple(tracks), tuple(what.report_ids[number] for number in heard))


def _is_refuted(story: Story, parameters: FeatureMergeParameters) -> bool:
    """Whether enough vehicles deny what has never been published: it was nothing."""
    noes = sum(cast.vote.existence.state == "absent" for cast in story.votes.values())
    is_new = story.shown is None and story.track.epoch is None
    return is_new and noes >= parameters.min_vehicles and story.masses.state == "absent"


def _is_kept(story: Story) -> bool:
    return story.track.epoch is not None or (story.is_published and not story.is_away)


def _day_of(story: Story, day: int) -> int:
    """When somebody last spoke for it."""
    track = story.track
    speaks = any(number >= 0 and vote.existence.state == "exist" for number, vote in track.votes.items())
    return day if speaks or track.measured or track.before is None else track.before.day


def _fair(stories: Sequence[Story]) -> list[Story]:
    """Within `MOST_LONELY`, at the cost of the vehicle that has found most by itself."""
    of: dict[str, list[int]] = defaultdict(list)
    for k, story in enumerate(stories):
        if finder := _finder(story):
            of[finder].append(k)
    out: set[int] = set()
    for _ in range(sum(map(len, of.values())) - MOST_LONELY):
        most = max(sorted(of), key=lambda vehicle: len(of[vehicle]))
        out.add(of[most].pop(0))
    return [story for k, story in enumerate(stories) if k not in out]


def _finder(story: Story) -> str:
    alone = story.shown is None and not story.track.is_of_map and story.vehicles_before == 0
    return next(iter(story.measured)) if alone and len(story.measured) == 1 else ""


def _votes_of(story: Story) -> tuple[tuple[int, Vote], ...]:
    casts = list(story.votes.values())[-max(VOTES_KEPT, FEATURE_VOTERS) :]
    return tuple((cast.report, cast.vote) for cast in casts)


def _remembered(
    story: Story, votes: tuple[tuple[int, Vote], ...], names: tuple[int, ...], apart: frozenset[int], day: int
) -> Remembered:
    track = story.track
    dropped = [cast.vote for cast in list(story.votes.values())[: len(story.votes) - len(votes)]]
    ayes = [vote for vote in dropped if vote.existence.state == "exist"]
    newest = sorted(story.measured, key=lambda vehicle: story.last.get(vehicle, -1))
    before = newest[:-MEASURERS_KEPT]
    gone = story.gone | {one: story.measured[one].earlier + story.measured[one].repeats for one in before}
    ayes_gone = story.ayes_gone | {vote.vehicle: vote.hits for vote in ayes}
    return Remembered(
        track.feature_id, track.kind, names, track.state, track.epoch, track.quoted, story.shown, story.is_published,
        story.is_settled, story.is_away,
        votes=votes,
        measured=tuple(own for vehicle, own in story.measured.items() if vehicle not in before),
        known=_known(story, set(before)),
        vehicles_before=story.vehicles_before + len(before),
        ayes_before=story.ayes_before + len(ayes),
        hits_before=story.hits_before + sum(vote.hits for vote in ayes),
        apart=apart,
        day=day,
        gone=tuple(gone.items())[-GONE_KEPT:],
        ayes_gone=tuple(ayes_gone.items())[-GONE_KEPT:],
    )  # fmt: skip


def _known(story: Story, before: set[str]) -> PlaceEstimate | None:
    """What was known, with what these vehicles have measured: each weighs what it weighed beside the others."""
    places = [place for vehicle, place in story.balanced().items() if vehicle in before] if before else []
    places = [*([] if story.known is None else [story.known]), *places]
    if story.grows:  # the longest piece of a line lends its vertices
        places.sort(key=lambda place: -length_of(place.points_m))
    return estimate(places[1:], places[0]) if places else None


def _names(what: Hypotheses, story: Story, cited: set[int]) -> tuple[int, ...]:
    """The ids that somebody may still name it by."""
    names = [name for name in what.names.get(story.track.serial, ()) if name != story.track.feature_id]
    newest = set(names[-NAMES_KEPT:])
    return tuple(name for name in names if name in newest or name in cited)


def _apart(tracks: Sequence[FeatureTrack], reach_m: float) -> Mapping[int, frozenset[int]]:
    """Which of them are not one although they might be by their estimates, since a report has distinguished them."""
    found: dict[int, set[int]] = defaultdict(set)
    like: dict[tuple[str, bool], list[int]] = defaultdict(list)
    for k, track in enumerate(tracks):
        like[track.kind, track.is_point].append(k)
    for (_, is_point), own in like.items():
        at = np.array([tracks[k].state.points_m[0, :2] for k in own])
        for i, k in enumerate(own):
            near = np.hypot(*(at[:i] - at[i]).T) <= 2.0 * reach_m if is_point else np.ones(i, bool)
            for j in np.flatnonzero(near).tolist():
                other = tracks[own[j]]
                if tracks[k].epoch is None and other.is_apart(tracks[k]):
                    found[k].add(own[j])
    return {k: frozenset(others) for k, others in found.items()}
