"""The voxel map around an agent: tiles ahead are asked for over the bus, and what others changed is applied."""

import threading

from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.link.link import Link
from gnd.vehicle_agent.link.updates import Updates
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import Surroundings


class TilesOnTheBus:
    """Keeps the local map of a vehicle in step with its place and with the cloud."""

    def __init__(
        self, link: Link, local_map: LocalMap, touched: Touched, config: AgentConfig, stop: threading.Event
    ) -> None:
        self._surroundings = Surroundings(local_map, link.fetcher, touched, config.download)
        self._stop, self._waits = stop, config.waits_for_tiles
        self._waits_first = bool(config.live.source)
        """A vehicle that starts now stands: its first sweeps wait for the tiles around it, or for its cache."""
        self.updates: Updates[Tile] = Updates(link.bus, link.cache, link.fetcher, self._surroundings.replace)

    def follow(self, place: Place) -> None:
        """Apply what others changed, and hold the tiles around and ahead."""
        self.updates.apply()
        self.updates.follow(self._surroundings.look_ahead(place))  # before asking: nothing is missed in between
        self._surroundings.follow(place, self._stop, wait=self._waits or self._waits_first)
        self._waits_first = False
