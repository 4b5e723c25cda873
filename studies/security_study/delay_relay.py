"""A relay that gives a connection the delay and the rates of a mobile link (no loss), where there are no namespaces."""

import asyncio
import threading
from contextlib import suppress

from gnd.fleet_bus.links import LinkProfile


class DelayRelay:
    """Listens on a free loopback port and passes everything on, late; use it in a `with` block.

    Args:
        port: on the loopback interface, where it passes connections on to.
        link: whose delay and rates it imitates.
    """

    def __init__(self, port: int, link: LinkProfile) -> None:
        self._to, self._link = port, link
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self.port = 0

    def __enter__(self) -> "DelayRelay":
        threading.Thread(target=self._run, name="relay", daemon=True).start()
        self._ready.wait()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._loop.call_soon_threadsafe(self._end)

    def _end(self) -> None:
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.call_soon(self._loop.stop)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", 0))
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        self._loop.run_forever()
        server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await asyncio.sleep(2 * self._link.delay_s)  # the handshake of TCP itself: one round trip
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._to)
        await asyncio.gather(self._pass(reader, far_writer, "up"), self._pass(far_reader, writer, "down"))

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, direction: str) -> None:
        rate, free_s = self._link.rate_byte_s(direction), 0.0
        with suppress(OSError, asyncio.CancelledError):
            while data := await source.read(1400):
                free_s = max(self._loop.time(), free_s) + len(data) / rate
                self._loop.call_at(free_s + self._link.delay_s, sink.write, data)
        self._loop.call_later(self._link.delay_s, sink.close)
