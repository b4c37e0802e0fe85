"""Draws a course part by part: motions, holds, shapes, and what falls due beside them."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pamctl.control.course import Cue, Plan, Segment
from pamctl.control.waves import Faded, Shape, Transition
from pamctl.signals import Phase

APPROACH_M_PER_S = 4e-3
"""Mean speed of the motion to where a part begins."""
SHORTEST_FIRST_APPROACH_S = 5.0
SHORTEST_APPROACH_S = 1.0
SETTLE_S = 2.0
"""Rest after an approach."""
MOST_SEGMENTS = 2_000_000
MOST_CUES = 50_000


class Sketch:
    """A course in the making, in SI. In closed loop every part begins and ends at rest."""

    def __init__(self, *, is_valve: bool) -> None:
        """Begin at the vented muscle, or with the valve closed."""
        self._is_valve = is_valve
        self._here = 0.0
        self._now_s = 0.0
        self._segments: list[Segment] = []
        self._cues: list[Cue] = []
        self.chance = random.Random(0)
        """What the part that is drawn takes its random numbers from."""

    def finish(self) -> Plan:
        """Return the course. The marks of a trigger are numbered in their order, from 1."""
        counts: Counter[str] = Counter()
        cues = []
        for cue in self._cues:
            if cue.trigger:
                counts[cue.trigger] += 1
                cue = cue._replace(mark=f"{cue.trigger} {counts[cue.trigger]}")
            cues.append(cue)
        return Plan(tuple(self._segments), tuple(sorted(cues, key=lambda cue: cue.at_s)))

    def approach(self, there: float) -> None:
        """Go to where a part begins, and settle; a valve command is simply set."""
        is_first = not self._segments
        if self._is_valve:
            self._here = there
        elif is_first or there != self._here:
            shortest_s = SHORTEST_FIRST_APPROACH_S if is_first else SHORTEST_APPROACH_S
            lasts_s = max(abs(there - self._here) / APPROACH_M_PER_S, shortest_s)
            self.move(there, lasts_s, Phase.APPROACH)
            self.move(there, SETTLE_S, Phase.APPROACH)

    def move(self, there: float, duration_s: float, phase: Phase = Phase.TRACK) -> None:
        """Go from rest to rest."""
        if self._is_valve:
            self.draw(Transition(self._here, there, duration_s), duration_s, there)
        else:
            self._add(Segment(phase, duration_s, self._here, there, math.nan), there)

    def hold(self, duration_s: float) -> None:
        """Stay."""
        here = self._here
        if self._is_valve:
            self._add(Segment(Phase.OPEN_LOOP, duration_s, math.nan, math.nan, here), here)
        else:
            self._add(Segment(Phase.REST, duration_s, here, here, math.nan), here)

    def hold_valve(self, valve_v: float, duration_s: float) -> None:
        """Hold a valve command."""
        self._here = valve_v
        self.hold(duration_s)

    def hold_each(self, commands_v: Iterable[float], duration_s: float) -> None:
        """Hold samples of a wave, each for equally long, within the range of a command."""
        levels_v = [min(max(command_v, -5.0), 5.0) for command_v in commands_v]
        self._refuse_too_long(len(levels_v))
        phase, nan = Phase.OPEN_LOOP, math.nan
        self._segments += [Segment(phase, duration_s, nan, nan, v) for v in levels_v]
        self._now_s += len(levels_v) * duration_s
        self._here = levels_v[-1]

    def draw(self, shape: Shape, duration_s: float, end: float, phase: Phase = Phase.TRACK) -> None:
        """Follow a shape that begins here and ends at `end`."""
        if self._is_valve:
            segment = Segment(Phase.OPEN_LOOP, duration_s, math.nan, math.nan, 0.0, shape)
        else:
            segment = Segment(phase, duration_s, self._here, end, math.nan, shape)
        self._add(segment, end)

    def draw_wave(
        self,
        wave: Shape,
        offset: float,
        duration_s: float,
        fades_s: tuple[float, float],
        full_from_s: float = 0.0,
    ) -> None:
        """Follow a wave about `offset` that grows from nothing and decays to nothing.

        It is full for `duration_s`, from its own time `full_from_s` on. Before that it grows for
        the first of `fades_s`, and after that it decays for the second; the figures of merit leave
        both out.
        """
        grows_s, decays_s = fades_s
        self.approach(offset)
        into = Faded(wave, offset, full_from_s - grows_s, 0.0, 1.0, grows_s)
        self.draw(into, grows_s, math.nan, Phase.APPROACH)
        self.draw(Faded(wave, offset, full_from_s, 1.0, 1.0, duration_s), duration_s, math.nan)
        out_of = Faded(wave, offset, full_from_s + duration_s, 1.0, 0.0, decays_s)
        self.draw(out_of, decays_s, offset, Phase.APPROACH)

    def trigger(
        self, word: str | None, period_s: float, periods: int, ahead_s: float = 0.0
    ) -> None:
        """Put marks at the starts of periods to come, the first `ahead_s` from now."""
        if word is None:
            return
        self._refuse_many_cues(periods)
        first_s = self._now_s + ahead_s
        self._cues += (Cue(first_s + i * period_s, trigger=word) for i in range(periods))

    def mark(self, text: str) -> None:
        """Put a remark."""
        self._refuse_many_cues(1)
        self._cues.append(Cue(self._now_s, text))

    def change_gains(self, gains: Mapping[str, Any], ramp_s: float) -> None:
        """Change gains from here on."""
        self._cues.append(Cue(self._now_s, gains=gains, ramp_s=ramp_s))

    def repeat(self, times: int, draw_once: Callable[[], None]) -> None:
        """Draw a part several times. From the second time on it begins where it ends."""
        draw_once()
        if times == 1:
            return
        began_s, segment, cue = self._now_s, len(self._segments), len(self._cues)
        draw_once()
        lasts_s = self._now_s - began_s
        segments, cues = self._segments[segment:], self._cues[cue:]
        self._refuse_too_long(len(segments) * (times - 2))
        self._refuse_many_cues(len(cues) * (times - 2))
        for turn in range(1, times - 1):
            self._segments += segments
            self._cues += (c._replace(at_s=c.at_s + turn * lasts_s) for c in cues)
        self._now_s = began_s + (times - 1) * lasts_s

    def _add(self, segment: Segment, end: float) -> None:
        self._refuse_too_long(1)
        self._segments.append(segment)
        self._now_s += segment.duration_s
        self._here = end

    def _refuse_too_long(self, more: int) -> None:
        if len(self._segments) + more > MOST_SEGMENTS:
            raise ValueError(f"the experiment has more than {MOST_SEGMENTS} parts with its repeats")

    def _refuse_many_cues(self, more: int) -> None:
        if len(self._cues) + more > MOST_CUES:
            raise ValueError(f"the experiment has more than {MOST_CUES} marks and gain changes")
