"""The session for asyncio: the same rig, awaited; a cancelled call stops the motion."""

from __future__ import annotations

import asyncio
import inspect
from pathlib import Path

import pytest
from support.processes.daemons import QUICK

import pamctl
from pamctl.aio import AsyncRig
from pamctl.exit_codes import ExitCode
from pamctl.session.steered_rig import SteeredRig

SINE = pamctl.Sine(offset_mm=3, amplitude_mm=1, frequency_hz=2, cycles=2)


def test_two_rigs_move_at_once_and_a_wrong_order_raises(tmp_path: Path) -> None:
    async def work() -> list[pamctl.Run]:
        one = pamctl.aio.simulate(logs=tmp_path / "1", overrides=QUICK, seed=1)
        other = pamctl.aio.simulate(logs=tmp_path / "2", overrides=QUICK, seed=2)
        async with one, other:
            with pytest.raises(pamctl.PamctlError, match="outside the stroke"):
                await one.goto(1.0)
            await one.start(SINE)
            ticks = [tick["tick"] async for tick in one.live(10, duration_s=0.5)]
            assert len(ticks) == 5
            return [*await asyncio.gather(one.wait(), other.run(SINE))]

    runs = asyncio.run(work())
    assert [run.ending.code for run in runs] == [ExitCode.OK, ExitCode.OK]
    assert len(runs[0]) == len(runs[1]) or runs[0].metrics != runs[1].metrics


def test_a_cancelled_run_stops_smoothly_and_the_rig_goes_on(tmp_path: Path) -> None:
    endless = pamctl.Sine(offset_mm=3, amplitude_mm=1, frequency_hz=1, cycles=10_000)

    async def work() -> Path:
        async with pamctl.aio.simulate(logs=tmp_path, overrides=QUICK) as rig:
            going_on = asyncio.create_task(rig.run(endless))  # type: ignore[arg-type]
            while not list(tmp_path.glob("*.mcap")):
                await asyncio.sleep(0.01)
            going_on.cancel()
            with pytest.raises(asyncio.CancelledError):
                await going_on
            assert (await rig.status())["run"] is None
            return (await rig.run(SINE)).path

    last = asyncio.run(work())
    (cancelled,) = (path for path in tmp_path.glob("*.mcap") if path != last)
    assert pamctl.Run.open(cancelled).ending.reason == "interrupted"


def test_two_first_calls_at_once_connect_once_and_a_second_close_does_nothing(
    tmp_path: Path,
) -> None:
    made: list[SteeredRig] = []

    def make() -> SteeredRig:
        made.append(pamctl.simulate(logs=tmp_path, overrides=QUICK))
        return made[-1]

    async def work() -> list[dict[str, object]]:
        rig = AsyncRig(make)
        told = await asyncio.gather(rig.status(), rig.settings(), rig.status())
        await asyncio.gather(rig.close(), rig.close())
        return told

    told = asyncio.run(work())
    assert len(made) == 1
    clocks = {"uptime_s", "disk_free_bytes"}
    first, second = ({k: v for k, v in each.items() if k not in clocks} for each in told[::2])
    assert first == second


def test_every_method_of_a_rig_is_awaited_too() -> None:
    public = {
        name
        for name, member in inspect.getmembers(SteeredRig, inspect.isfunction)
        if not name.startswith("_")
    }
    assert public - {"interrupt"} <= {*dir(AsyncRig)}
    assert AsyncRig.goto.__doc__ == SteeredRig.goto.__doc__
