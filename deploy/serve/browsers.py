"""The browsers that look on: each has a queue of its own, and one that does not keep up is told to read all anew."""

import asyncio
import json
from typing import Any, Final

QUEUED: Final = 512
"""So many messages wait for a browser."""
MOST_BROWSERS: Final = 64
RELOAD: Final = json.dumps({"type": "reload"})


class BrowserHub:
    """Hands each message to every browser. `tell` may be called from any thread, all else from the server's loop."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[str]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None

    @property
    def count(self) -> int:
        """How many browsers look on."""
        return len(self._queues)

    def begin(self) -> None:
        """Remember the loop that this is called in."""
        self._loop = asyncio.get_running_loop()

    def join(self) -> asyncio.Queue[str] | None:
        """The queue of one more browser; None: there are too many."""
        if len(self._queues) >= MOST_BROWSERS:
            return None
        queue: asyncio.Queue[str] = asyncio.Queue(QUEUED)
        self._queues.add(queue)
        return queue

    def leave(self, queue: asyncio.Queue[str]) -> None:
        """Forget a browser."""
        self._queues.discard(queue)

    def tell(self, message: dict[str, Any]) -> None:
        """Give a message to all."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self.spread, json.dumps(message, separators=(",", ":")))

    def spread(self, text: str) -> None:
        """Put a text into every queue; a full one is emptied and gets the order to reload in its place."""
        for queue in self._queues:
            if queue.full():
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(RELOAD)
            else:
                queue.put_nowait(text)
