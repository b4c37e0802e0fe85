"""The plant of a simulated rig: parameters and a state that advances in time."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from pamctl.kernel.calls import Call, PlainCall
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.step import advance_plant, sensed_position_m, sensed_pressure_pa

LONGEST_STEP_S = 0.5e-3
"""Two steps a tick at 1 kHz: 0.6 um from the converged solution."""
_ROOM = 4096
"""Commands that a plant without a clock may have on their way."""


class CommandLine(NamedTuple):
    """Commands on their way to the valve; the first one acts from the start."""

    written_s: Any
    """When each was written, on the plant's clock; an array with room for those to come."""
    written_v: Any


class OnTheWay(NamedTuple):
    """Where the commands of a line are."""

    written: int = 0
    """Number of commands in the line."""
    arrived: int = 0
    """The command that acts now."""
    now_s: float = 0.0


def make_line(p: PlantParameters, room: int = _ROOM) -> CommandLine:
    """Return an empty line for a plant: without a delay of the command it holds none."""
    size = 8 * (room if p.effects.timing.command_delay.delay_s > 0.0 else 1)
    return CommandLine(array("d", bytes(size)), array("d", bytes(size)))


def make_room(
    p: PlantParameters, line: CommandLine, on_way: OnTheWay, commands: int
) -> tuple[CommandLine, OnTheWay]:
    """Return a line with room for more commands: those that have arrived are forgotten."""
    if p.effects.timing.command_delay.delay_s <= 0.0:
        return line, on_way
    if on_way.written + commands <= len(line.written_s):
        return line, on_way
    waiting = slice(on_way.arrived, on_way.written)
    more = array("d", bytes(8 * max(commands, _ROOM)))
    made = CommandLine(line.written_s[waiting] + more, line.written_v[waiting] + more)
    return made, OnTheWay(on_way.written - on_way.arrived, 0, on_way.now_s)


def advance_muscle(
    p: PlantParameters,
    line: CommandLine,
    muscle: PlantState,
    on_way: OnTheWay,
    command_v: float,
    duration_s: float,
    longest_step_s: float,
) -> tuple[PlantState, OnTheWay]:
    """Kernel: write a command (V) and advance; it acts at once, or after the plant's delay."""
    if p.effects.timing.command_delay.delay_s <= 0.0:
        return advance_plant(p, muscle, command_v, duration_s, longest_step_s), on_way
    line.written_s[on_way.written] = on_way.now_s
    line.written_v[on_way.written] = command_v
    written = on_way.written + 1
    muscle, arrived = advance_delayed_plant(
        p,
        muscle,
        line.written_s,
        line.written_v,
        written,
        on_way.arrived,
        on_way.now_s,
        duration_s,
        longest_step_s,
    )
    return muscle, OnTheWay(written, arrived, on_way.now_s + duration_s)


def show_muscle(p: PlantParameters, muscle: PlantState) -> tuple[float, float]:
    """Kernel: return what the sensors show, without noise and steps: m, and absolute Pa."""
    return (
        sensed_position_m(p, muscle.position_m, muscle.sensors, muscle.age_s),
        sensed_pressure_pa(p, muscle.pressure_pa, muscle.air, muscle.sensors, muscle.age_s),
    )


class ShownMuscle(NamedTuple):
    """A muscle, the commands on their way to it, and what its sensors show."""

    muscle: PlantState
    on_way: OnTheWay
    position_m: float
    pressure_pa: float


class Held(NamedTuple):
    """A command, and for how long it is held."""

    command_v: float
    duration_s: float


def advance_and_show(
    p: PlantParameters, line: CommandLine, shown: ShownMuscle, held: Held
) -> ShownMuscle:
    """Kernel: advance under a command, and read the sensors."""
    muscle, on_way = advance_muscle(
        p, line, shown.muscle, shown.on_way, held.command_v, held.duration_s, LONGEST_STEP_S
    )
    position_m, pressure_pa = show_muscle(p, muscle)
    return ShownMuscle(muscle, on_way, position_m, pressure_pa)


class SimulatedPlant:
    """The plant of Eq. 9, as `hal.sim` calls it.

    A loop in real time has a fraction of a period for it, and gives `prepare` of
    `pamctl.kernel.calls`.
    """

    def __init__(
        self, parameters: PlantParameters, prepare: Callable[..., Call] = PlainCall
    ) -> None:
        """Start vented and at rest. `prepare` makes the call."""
        self.parameters = parameters
        self.line = make_line(parameters)
        muscle = vented_state(parameters)
        shown = ShownMuscle(muscle, OnTheWay(), *show_muscle(parameters, muscle))
        arguments = {"p": parameters, "line": self.line, "shown": shown, "held": Held(0.0, 0.0)}
        call = self._call = prepare(advance_and_show, arguments, ("shown",))
        self._shown_m, self._shown_pa = (
            call.reader("shown", name) for name in ("position_m", "pressure_pa")
        )
        self._true_m, self._true_pa = (
            call.reader("shown", f"muscle.{name}") for name in ("position_m", "pressure_pa")
        )
        self._written = call.reader("shown", "on_way.written")
        self._is_delayed = parameters.effects.timing.command_delay.delay_s > 0.0

    def advance(self, command_v: float, duration_s: float) -> None:
        """Advance under a constant valve command (V)."""
        if self._is_delayed and self._written() == len(self.line.written_s):
            self.give_room(1)
        self._call.put("held", Held(command_v, duration_s))
        self._call.run()

    def give_room(self, commands: int) -> None:
        """Make room in the line for so many commands."""
        on_way = self.on_way
        self.line, moved = make_room(self.parameters, self.line, on_way, commands)
        self._call.put("line", self.line)
        if moved is not on_way:
            self.put(self.state, moved)

    def put(self, state: PlantState, on_way: OnTheWay) -> None:
        """Set the true state, and where the commands of the line are."""
        shown = ShownMuscle(state, on_way, *show_muscle(self.parameters, state))
        self._call.put("shown", shown)

    @property
    def state(self) -> PlantState:
        """The true state."""
        shown: ShownMuscle = self._call.get("shown")
        return shown.muscle

    @state.setter
    def state(self, state: PlantState) -> None:
        self.put(state, self.on_way)

    @property
    def on_way(self) -> OnTheWay:
        """The commands on their way to the valve."""
        shown: ShownMuscle = self._call.get("shown")
        return shown.on_way

    @property
    def truth(self) -> tuple[float, float]:
        """True displacement (m) and absolute pressure (Pa)."""
        return self._true_m(), self._true_pa()

    @property
    def position_m(self) -> float:
        """Displacement at the encoder, before quantisation."""
        shown_m: float = self._shown_m()
        return shown_m

    @property
    def pressure_pa(self) -> float:
        """Absolute pressure at the sensor, before noise."""
        shown_pa: float = self._shown_pa()
        return shown_pa


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
