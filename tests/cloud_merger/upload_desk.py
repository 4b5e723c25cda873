"""Ingest and expander at one desk: what is sent is acknowledged, looked at, and what is told can be read."""

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.states import answer
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import state_key
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates

NOW = 1_700_000_100_000_000_000


class Desk:
    """One shard without its bus; `told` is what it has said, with the vehicle that it was said to."""

    def __init__(self, store, name="desk", on_journaled=lambda: None, on_stored=lambda: None, now_ns=NOW, **settings):
        config = ShardConfig(name, **settings)
        self.store, self.told = store, []
        self.ingest = Ingest(store, name, on_stored, now_ns=lambda: now_ns)
        self.expander = Expander(store, config, self._tell, on_journaled)

    def _tell(self, vehicle, state):
        self.told.append((vehicle, state))

    def work(self):
        """Until nothing waits."""
        while self.expander.work():
            pass

    def ack(self, key, payload):
        return self.ingest.answer(key, payload)

    def send(self, key, payload) -> ReportState | ChangeAck:
        """What is told after an upload was looked at; its ack where nothing is told."""
        ack, before = self.ack(key, payload), len(self.told)
        self.work()
        return self.told[-1][1] if len(self.told) > before else ack

    def state(self, vehicle, report_id) -> ReportState:
        """What a vehicle hears when it asks."""
        question = ReportQuestion((report_id,)).encode()
        return ReportStates.decode(answer(self.store, state_key(vehicle), question)).states[0]
