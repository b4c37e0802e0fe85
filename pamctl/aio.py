"""The session for programs that use asyncio: the same rigs, whose methods are awaited.

    async with pamctl.aio.connect() as rig:
        await rig.goto(12e-3)
        async for tick in rig.live(20):
            ...

Each method is the one of `SteeredRig`, called in a thread of the rig's own. Orders to one rig are
carried out one after the other, and `estop` at once. A cancelled call stops the motion smoothly.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from pamctl.daemon.protocol import list_orders
from pamctl.daemon.rig_session import RigSession
from pamctl.session.daemon_rig import connect as _connect
from pamctl.session.simulated_rig import simulate as _simulate
from pamctl.session.steered_rig import InterruptedWaitError, SteeredRig

_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")


def _await_method(
    method: Callable[Concatenate[SteeredRig, _Given], _Answer],
) -> Callable[Concatenate[AsyncRig, _Given], Awaitable[_Answer]]:
    """Return the awaitable twin of a method."""
    name = method.__name__

    async def call(rig: AsyncRig, /, *args: _Given.args, **options: _Given.kwargs) -> _Answer:
        steered = await rig._open()
        # By its name: each kind of rig has its own.
        return await rig._call(partial(getattr(steered, name), *args, **options))

    call.__name__, call.__doc__ = name, method.__doc__
    return call


class AsyncRig:
    """A rig whose methods are awaited; `async with` leaves it safe."""

    def __init__(self, make: Callable[[], SteeredRig]) -> None:
        """`make` connects, when the rig is first used."""
        self._make = make
        self._rig: SteeredRig | None = None
        self._is_closed = False
        # One thread, which alone works with the rig: it carries out call after call.
        self._worker = ThreadPoolExecutor(1, "pamctl rig")

    run = _await_method(SteeredRig.run)
    start = _await_method(SteeredRig.start)
    wait = _await_method(SteeredRig.wait)
    goto = _await_method(SteeredRig.goto)
    sleep = _await_method(SteeredRig.sleep)
    set = _await_method(SteeredRig.set)
    load = _await_method(SteeredRig.load)
    mark = _await_method(SteeredRig.mark)
    status = _await_method(SteeredRig.status)
    settings = _await_method(SteeredRig.settings)
    stop = _await_method(SteeredRig.stop)
    disarm = _await_method(SteeredRig.disarm)
    ack = _await_method(SteeredRig.ack)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Callable[..., Awaitable[Any]]:
            """Give any order of the session by its name, as `SteeredRig` does."""
            if name not in list_orders(RigSession):
                raise AttributeError(f"a rig has no {name!r}")

            async def call(*args: Any, **options: Any) -> Any:
                rig = await self._open()
                return await self._call(partial(getattr(rig, name), *args, **options))

            return call

    async def estop(self) -> None:
        """Drive the safe voltage at once; it waits for no call that is going on."""
        rig = await self._open()
        await asyncio.to_thread(rig.estop)

    async def live(
        self, rate_hz: float = 50.0, *, duration_s: float | None = None
    ) -> AsyncIterator[Mapping[str, float]]:
        """Yield the newest ticks, as `SteeredRig.live` does."""
        rig = await self._open()
        ticks: Iterator[Mapping[str, float]] = rig.live(rate_hz, duration_s=duration_s)
        while (tick := await self._call(partial(next, ticks, None))) is not None:
            yield tick

    async def close(self) -> None:
        """Stop what was begun here and leave the rig safe."""
        if not self._is_closed:
            self._is_closed = True
            await self._call(self._close_here)
            self._worker.shutdown(wait=False)

    async def __aenter__(self) -> AsyncRig:
        """Connect, and return itself."""
        await self._open()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop what was begun here and leave the rig safe."""
        await self.close()

    async def _open(self) -> SteeredRig:
        return await self._call(self._open_here) if self._rig is None else self._rig

    def _open_here(self) -> SteeredRig:
        """Connect, in the worker's thread: of two first calls the second finds the rig there."""
        if self._rig is None:
            self._rig = self._make()
        return self._rig

    def _close_here(self) -> None:
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()

    async def _call(self, work: Callable[[], _Answer]) -> _Answer:
        going_on = asyncio.get_running_loop().run_in_executor(self._worker, _call_quietly, work)
        try:
            return await asyncio.shield(going_on)
        except asyncio.CancelledError:
            if self._rig is not None:
                self._rig.interrupt()
            await asyncio.wait([going_on])
            raise


def _call_quietly(work: Callable[[], _Answer]) -> _Answer:
    """Turn the interruption of a wait into a cancellation: executors pass on exceptions only."""
    try:
        return work()
    except InterruptedWaitError:
        raise asyncio.CancelledError from None


def _make_awaitable(make: Callable[_Given, SteeredRig]) -> Callable[_Given, AsyncRig]:
    def begin(*args: _Given.args, **options: _Given.kwargs) -> AsyncRig:
        return AsyncRig(partial(make, *args, **options))

    begin.__name__, begin.__doc__ = make.__name__, make.__doc__
    return begin


connect = _make_awaitable(_connect)
simulate = _make_awaitable(_simulate)
