"""Settles the trials of the districts that this shard owns: released, withdrawn, or waited for."""

import json
import logging
import math
import time
from collections.abc import Callable
from typing import Final

from gnd.cloud_merger.ownership import Members
from gnd.cloud_merger.release.doubts import clear_confirmed
from gnd.cloud_merger.release.verdict import LooksTaken, judged
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import clocks, releasing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.errors import StoreClosed
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import VersionTrial

KEEP_EVERY_S: Final = 1.0
NOTED_EVERY_S: Final = 10.0
"""How far a trial has come is written down no oftener, unless a look was taken."""
_LOG = logging.getLogger(__name__)


class ReleaseKeeper:
    """Looks at the open trials now and then; what it decides is one transaction, and is written down.

    Args:
        store: of the trials.
        members: whose district it is; that of a shard that has died falls to another.
        now_ns: the time of day, int ns UTC.
    """

    def __init__(self, store: SqlStore, members: Members, now_ns: Callable[[], int] = clocks.day_ns) -> None:
        self._store, self._members, self._now_ns = store, members, now_ns
        self._noted_s: dict[tuple[str, TileId, int], float] = {}

    def work(self) -> bool:
        """Judge every open trial once. Always False: there is nothing to do until the next look."""
        now_ns = self._now_ns()
        found = [one for one in self._store.look(trials.all_open) if one.state == "trial"]
        own = [one for one in found if self._members.is_mine(one.tile.district)]
        for trial in own:
            try:
                self._judge(trial, now_ns)
            except StoreClosed:
                raise
            except GndError as error:  # of one tile: the others go on
                _LOG.error("%s version %d cannot be judged: %s", trial.tile, trial.version, error)
        self._noted_s = {key: at_s for key, at_s in self._noted_s.items() if key in {_key(one) for one in own}}
        return False

    def _judge(self, trial: VersionTrial, now_ns: int) -> None:
        before = looks_taken(trial)
        said = self._store.look(lambda c: trials.health(c, trial))
        found = judged(trial, said, now_ns, before)
        who = f"shard {self._members.own}"
        if found.decision == "release":
            if releasing.release(self._store, trial, who, found.why, found.as_dict()):
                _LOG.info("%s version %d is released: %s", trial.tile, trial.version, found.why)
                clear_confirmed(self._store, trial, who)
        elif found.decision == "withdraw":
            if releasing.withdraw(self._store, trial, who, found.why, found.as_dict()):
                _LOG.warning("%s version %d is withdrawn: %s", trial.tile, trial.version, found.why)
        elif found.looks != before or self._is_due(trial):
            releasing.note_verdict(self._store, trial, found.as_dict())

    def _is_due(self, trial: VersionTrial) -> bool:
        now_s = time.monotonic()
        if now_s - self._noted_s.get(_key(trial), -math.inf) < NOTED_EVERY_S:
            return False
        self._noted_s[_key(trial)] = now_s
        return True


def _key(trial: VersionTrial) -> tuple[str, TileId, int]:
    return trial.layer, trial.tile, trial.version


def looks_taken(trial: VersionTrial) -> LooksTaken:
    """The looks that were taken of a trial so far."""
    return LooksTaken(**json.loads(trial.verdict)["looks"]) if trial.verdict else LooksTaken()
