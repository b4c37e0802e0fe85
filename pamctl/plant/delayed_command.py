"""The plant under commands that reach the valve late."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from pamctl.plant.step import advance_plant

if TYPE_CHECKING:
    from pamctl.plant.parameters import PlantParameters, PlantState


class Numbers(Protocol):
    """A list or an array."""

    def __getitem__(self, index: int, /) -> Any: ...


def advance_delayed_plant(
    p: PlantParameters,
    state: PlantState,
    written_s: Numbers,
    written_v: Numbers,
    count: int,
    arrived: int,
    now_s: float,
    duration_s: float,
    longest_step_s: float,
) -> tuple[PlantState, int]:
    """Advance under commands (V) that act `command_delay` after they were written.

    `written_s` and `written_v` hold `count` commands with their times, in order; `arrived` is the
    index of the command that acts now; the new index is returned. The time is cut exactly where a
    command arrives.
    """
    delay_s = p.effects.timing.command_delay.delay_s
    end_s = now_s + duration_s
    while arrived + 1 < count and written_s[arrived + 1] + delay_s < end_s:
        change_s = written_s[arrived + 1] + delay_s
        if change_s > now_s:
            held_s = change_s - now_s
            state = advance_plant(p, state, written_v[arrived], held_s, longest_step_s)
            now_s = change_s
        arrived += 1
    if end_s > now_s:
        state = advance_plant(p, state, written_v[arrived], end_s - now_s, longest_step_s)
    return state, arrived
