"""A line between one client and the router that can be cut, held up, and mended: bytes are carried, nothing is read."""

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any, Final, Literal, TypeVar

_CHUNK: Final = 65_536
_HOST: Final = "127.0.0.1"
_PATIENCE_S: Final = 10.0

State = Literal["whole", "cut", "held"]
_T = TypeVar("_T")


class _WireLine:
    """One line: a listening port, and the connections that were made over it."""

    def __init__(self, router: int) -> None:
        self._router = router
        self._ends: set[asyncio.StreamWriter] = set()
        self._state: State = "whole"
        self._free = asyncio.Event()
        self._free.set()
        self._server: asyncio.Server | None = None

    async def open(self) -> int:
        """Listen; the port."""
        self._server = await asyncio.start_server(self._connected, _HOST, 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def become(self, state: State) -> None:
        """Cut, hold or mend."""
        self._state = state
        if state == "held":
            self._free.clear()
        else:
            self._free.set()
        if state == "cut":
            self._abort()

    async def close(self) -> None:
        """End all."""
        await self.become("cut")
        if self._server is not None:
            self._server.close()

    def _abort(self) -> None:
        for end in self._ends:
            end.transport.abort()
        self._ends.clear()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._state == "cut":
            writer.transport.abort()
            return
        try:
            there_reader, there_writer = await asyncio.open_connection(_HOST, self._router)
        except OSError:  # the router is down: the client finds nobody
            writer.transport.abort()
            return
        ends = {writer, there_writer}
        self._ends |= ends
        carried = [
            asyncio.ensure_future(self._carry(*pair)) for pair in ((reader, there_writer), (there_reader, writer))
        ]
        await asyncio.wait(carried, return_when=asyncio.FIRST_COMPLETED)
        for end in ends:
            end.transport.abort()
        self._ends -= ends
        await asyncio.gather(*carried, return_exceptions=True)

    async def _carry(self, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(_CHUNK):
                await self._free.wait()
                target.write(data)
                await target.drain()


class Wires:
    """Lines by name, carried by one thread. Use it in a `with` block.

    Args:
        router: port of the router.
    """

    def __init__(self, router: int) -> None:
        self._router = router
        self._loop = asyncio.new_event_loop()
        self._lines: dict[str, _WireLine] = {}
        self._thread = threading.Thread(target=self._loop.run_forever, name="wires", daemon=True)

    def __enter__(self) -> "Wires":
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        for line in self._lines.values():
            self._call(line.close())
        self._call(asyncio.sleep(0.05))  # connections that were aborted come to their end
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def open(self, name: str) -> str:
        """Lay a line; the endpoint at which its client finds the router."""
        line = _WireLine(self._router)
        self._lines[name] = line
        return f"tcp/{_HOST}:{self._call(line.open())}"

    def cut(self, name: str) -> None:
        """Both ends lose their connection, and nobody gets a new one."""
        self._call(self._lines[name].become("cut"))

    def hold(self, name: str) -> None:
        """Hold back all data in both directions, without either end noticing."""
        self._call(self._lines[name].become("held"))

    def mend(self, name: str) -> None:
        """All goes through again, what was held up first."""
        self._call(self._lines[name].become("whole"))

    def _call(self, work: Coroutine[Any, Any, _T]) -> _T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(_PATIENCE_S)
