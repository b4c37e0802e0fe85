"""What the rigs on a card share: the safe voltage on every way in and out.

An M Series card has no watchdog and holds its last output voltage when a task stops, a process
dies, or the driver unloads. So `open` writes the safe voltage first, and every way out writes it
last. A dying process may still hold the output: then it is tried again and again.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from typing import Generic, TypeVar

from hal.converter import nearest_output_v
from hal.m_series import MSeriesWiring, card_output
from hal.rig import RigError

Settings = TypeVar("Settings", bound=MSeriesWiring)
Wired = TypeVar("Wired")

# Shorter than the heartbeat: a loop that tries for longer is killed, and its reason is lost. The
# guardian goes on trying.
_TRIES = 6
_TRIES_AS_OPEN = 2
_RETRY_S = 5e-3


class CardRig(ABC, Generic[Settings, Wired]):
    """A rig on one M Series card; `Wired` is what an open card offers."""

    def __init__(
        self,
        settings: Settings,
        *,
        safe_output_v: float,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`safe_output_v` is the analog output voltage at which the rig is safe."""
        self._settings = settings
        self._now_ns = now_ns
        self._output = card_output(settings)
        self._safe_v = nearest_output_v(self._output, safe_output_v)
        self._safe_output_v = safe_output_v
        self._wired: Wired | None = None
        self._held = ExitStack()
        self._counts = 0
        self._identity: Mapping[str, object] = {}
        self._safe_failure: Exception | None = None

    def open(self) -> None:
        """Drive the safe voltage, and only then take the inputs."""
        if self._wired is not None:
            raise RigError("the rig is open already", fix="call close() first")
        with self._explain_opening(), ExitStack() as acquired:
            wired = self._wire(acquired)
            self._counts = 0
            self._wired, self._held = wired, acquired.pop_all()

    def write(self, ao_v: float) -> float:
        """Put a voltage on the output: the nearest code within the configured range."""
        wired = self._require_open()
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="a law must command a finite voltage")
        admitted_v = nearest_output_v(self._output, ao_v)
        self._put_v(wired, admitted_v)
        return admitted_v

    def make_safe(self) -> None:
        """Drive the safe voltage, over the open card or over an output taken for this alone.

        If every try fails, `safe_failure` says why. An output that fails twice is released and
        taken again; to go on, the rig must then be opened again.
        """
        for attempt in range(_TRIES):
            try:
                self._drive_safe(as_open=attempt < _TRIES_AS_OPEN)
            # Any exception at all: the next try is worth more than the reason.
            except Exception as error:
                self._safe_failure = error
                if self._is_hopeless(error):
                    return
                time.sleep(_RETRY_S)
            else:
                self._safe_failure = None
                return

    def close(self) -> None:
        """Make safe, then release the card; the output holds the safe voltage."""
        self.make_safe()
        self._release()

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it did."""
        failure = self._safe_failure
        return None if failure is None else self._explain_failure(failure)

    @abstractmethod
    def _wire(self, acquired: ExitStack) -> Wired:
        """Write the safe voltage, and only then take the inputs."""

    @abstractmethod
    def _put_v(self, wired: Wired, volts: float) -> None:
        """Write to the output of an open card; raise `RigError`."""

    @abstractmethod
    def _write_safe_as_wired(self, wired: Wired) -> None:
        """Write the safe voltage to the output of an open card; anything may be raised."""

    @abstractmethod
    def _write_safe_alone(self) -> None:
        """Write the safe voltage through an output that is taken for this alone."""

    @abstractmethod
    def _is_hopeless(self, error: Exception) -> bool:
        """Tell whether no further try can help."""

    @abstractmethod
    def _explain_failure(self, failure: Exception) -> RigError:
        """Return the error of a safe voltage that could not be driven."""

    def _explain_opening(self) -> AbstractContextManager[None]:
        """Return what turns the driver's errors into `RigError` while the card is opened."""
        return nullcontext()

    def _drive_safe(self, *, as_open: bool) -> None:
        if self._wired is not None and as_open:
            self._write_safe_as_wired(self._wired)
        else:
            self._release()
            self._write_safe_alone()

    def _release(self) -> None:
        self._wired = None
        # Nothing can be done about a part of the card that cannot be released.
        with suppress(Exception):
            self._held.close()

    def _require_open(self) -> Wired:
        if self._wired is None:
            raise RigError("the card is not open", fix="call open() first")
        return self._wired
