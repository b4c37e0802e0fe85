"""Progress on standard error: of a run with its newest figures, and of any long work."""

from __future__ import annotations

import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress

from pamctl.signals import Phase, find_followed_m


class ProgressLine:
    """Rewrites itself on a terminal; elsewhere it prints a line every few seconds."""

    def __init__(self, *, quiet: bool, length_s: float = math.inf) -> None:
        """Print nothing if `quiet`; `length_s` is the run's length without homing, if it ends."""
        self._length_s = length_s
        self._end_s = math.inf
        self._quiet = quiet or sys.stderr is None
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._every_s = 0.1 if self._terminal else 5.0
        self._last_s = 0.0
        self._width = 0

    def __call__(self, tick: Mapping[str, float], worst_late_s: float) -> None:
        """Show the newest tick."""
        now_s = time.monotonic()
        if self._quiet or now_s - self._last_s < self._every_s:
            return
        self._last_s = now_s
        try:
            self._show(format_progress(tick, worst_late_s, self._find_end_s(tick)))
        except (OSError, ValueError):
            # Standard error is closed: the experiment goes on without it.
            self._quiet = True

    def _find_end_s(self, tick: Mapping[str, float]) -> float:
        """Return when the run ends; it is not known before homing has ended."""
        if self._end_s == math.inf and tick["phase"] != Phase.HOMING:
            self._end_s = tick["t_s"] + self._length_s
        return self._end_s

    def end_line(self) -> None:
        """Put the terminal's cursor on a new line."""
        if self._width and not self._quiet:
            with suppress(OSError, ValueError):  # the terminal was closed
                print(file=sys.stderr)

    def _show(self, text: str) -> None:
        if self._terminal:
            # A line that wraps could not be rewritten: it would scroll.
            text = text[: shutil.get_terminal_size().columns - 1]
            print("\r" + text.ljust(self._width), end="", file=sys.stderr, flush=True)
            self._width = len(text)
        else:
            print(text, file=sys.stderr, flush=True)


def format_progress(tick: Mapping[str, float], worst_late_s: float, end_s: float = math.inf) -> str:
    """Write one tick as a line in millimetres, micrometres and kilopascals, below 100 columns."""
    end = "" if math.isinf(end_s) else f" of {end_s:.0f}"
    phase = Phase(int(tick["phase"])).name.lower().replace("_", " ")
    motion = f"x {tick['position_m'] * 1e3:7.3f} mm"
    if tick["reference_m"] == tick["reference_m"]:
        error_um = (find_followed_m(tick) - tick["reference_m"]) * 1e6
        motion = f"{motion}  error {error_um:+8.1f} um"
    return (
        f"{tick['t_s']:5.1f}{end} s  {phase:<9} {motion}  "
        f"P {tick['pressure_pa'] * 1e-3:6.1f} kPa  u {tick['valve_v']:+6.3f} V  "
        f"wake-up {worst_late_s * 1e6:.0f} us"
    )


STARTING = "pamctl: starting"
_BEGAN_S = time.monotonic()
"""The program's start: this is imported first."""
_CLEAR = "\r\x1b[K"


class WorkProgress:
    """Says what long work does, how far it is and how long it will take; a context manager.

    It rewrites its line on a terminal; elsewhere, as in a file, it prints one every 10 s. A thread
    tells the time also while the work is in machine code. Work that ends within 2 s says nothing.

        with WorkProgress("compare") as show:
            show(1, 6, "paper, pressure block")
    """

    def __init__(self, what: str, *, is_verb: bool = False) -> None:
        """`is_verb`: it speaks of the whole program, on a terminal alone, until `end` is called.

        That is called before anything is printed. Without `what` nothing is shown.
        """
        self._what, self._saying, self._share = what, "", 0.0
        self._is_verb = is_verb
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._began_s, self._next_s = time.monotonic(), 2.0
        if is_verb:
            self._began_s, self._next_s = _BEGAN_S, max(0.7, time.monotonic() - _BEGAN_S)
        self._ended, self._shown, self._told = threading.Event(), threading.Lock(), False
        self._teller = threading.Thread(target=self._tell, name="progress", daemon=True)
        self._is_silent = not what or sys.stderr is None or (is_verb and not self._terminal)

    def __enter__(self) -> WorkProgress:
        if not self._is_silent:
            self._teller.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        if not self._is_silent:
            self._teller.join()

    def __call__(self, done: float, of: float, saying: str = "") -> None:
        """Note that so much of the work is done, and what is done now."""
        self._saying, self._share = saying, done / of if of else 0.0

    def end(self) -> None:
        """Say no more, and take away what is on the terminal."""
        if not self._ended.is_set():
            with self._shown:
                self._ended.set()
                if self._told:
                    _write(_CLEAR)

    def line(self) -> str:
        """Return what is said now."""
        spent_s = time.monotonic() - self._began_s
        what = f"{self._what}: {self._saying}" if self._saying else self._what
        build = sys.modules.get("pamctl.kernel.build")  # most verbs do without
        if build is not None and build.progress.builds:
            what += " (the first time after an update the model is compiled)"
        said = [what, f"{spent_s:.0f} s"]
        if 0.0 < self._share < 1.0:
            left_s = spent_s * (1.0 / self._share - 1.0)
            said.append(f"{self._share:.0%}, about {left_s:.0f} s left")
        return ", ".join(said)

    def _tell(self) -> None:
        every_s = 1.0 if self._terminal else 10.0
        with suppress(OSError, ValueError):  # standard error is closed: the work goes on
            while not self._ended.wait(max(0.0, self._began_s + self._next_s - time.monotonic())):
                if not self._is_verb:
                    sys.stderr.write("")  # what is said of the whole program ends
                with self._shown:
                    if self._ended.is_set():
                        return
                    if self._terminal:
                        self._told = True
                        _write(_CLEAR + self.line()[: shutil.get_terminal_size().columns - 1])
                    else:
                        print(self.line(), file=sys.stderr, flush=True)
                self._next_s = round(self._next_s) + every_s


def _write(text: str) -> None:
    """Write past Python's buffer, whose lock a worker process would inherit."""
    with suppress(OSError):  # the terminal was closed
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, text.encode())
