"""The front's side of the guardian: start it, notice when it is gone, ask what it did."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from typing import Any

from hal.rig import Rig
from pamctl.realtime.ending import Ending, ExitCode
from pamctl.realtime.guardian import Takeover, drive_safe
from pamctl.realtime.ring import Ring

_FROZEN_LOOKS = 20
"""A guardian that has not moved while the front looked so often is frozen: about a second, in
rounds of the front's own, so that a machine that stands still is no evidence."""
_END_PATIENCE_S = 15.0


class Guardianship:
    """A guardian and its front. Without a `command` there is none, and nothing to guard."""

    def __init__(self, ring: Ring, command: Sequence[str] | None, rig: Rig) -> None:
        """Start the guardian of a run; `rig` is what the front can make safe itself."""
        self._ring = ring
        self._rig = rig
        self._beats = 0
        self._still = 0
        self._process = command and subprocess.Popen(
            [*command, str(ring.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,
        )

    def look(self) -> None:
        """See whether the guardian lives; if not, the loop stops safe at its next tick."""
        if not self._process or self._ring.guardian_lost:
            return
        if self._is_frozen():
            self._process.kill()
            self._process.wait()
        if self._process.poll() is not None:
            self._ring.guardian_lost = 1

    def _is_frozen(self) -> bool:
        beats = self._ring.guardian_beats
        self._still = self._still + 1 if beats == self._beats else 0
        self._beats = beats
        return bool(self._ring.guardian_ready) and self._still > _FROZEN_LOOKS

    def verdict_on(self, ending: Ending) -> Ending:
        """Return how the run of a loop that is no more ended, the valve included."""
        if not self._process:
            return ending
        said = self._last_words(self._process)
        if said is None:
            return self._stand_in(ending)
        takeover = Takeover(**said) if said else None
        if takeover is None:
            return ending
        reason = takeover.reason or ending.reason
        if takeover.failure:
            return Ending(ExitCode.UNEXPECTED, _alarm(reason, takeover.failure))
        done = f"the guardian drove the safe voltage {takeover.latency_ms:.1f} ms later"
        return Ending(ExitCode.UNEXPECTED, f"{reason}; {done}")

    def _last_words(self, guardian: subprocess.Popen[bytes]) -> dict[str, Any] | None:
        """Return what the guardian reported, {} for nothing; None where it could not."""
        try:
            said, _ = guardian.communicate(timeout=_END_PATIENCE_S)
            return json.loads(said) or {}
        except subprocess.TimeoutExpired:
            guardian.kill()
            guardian.communicate()
        except ValueError:
            pass
        return None

    def _stand_in(self, ending: Ending) -> Ending:
        """Do what the guardian cannot do any more."""
        failure = drive_safe(self._rig)
        if failure is not None:
            return Ending(ExitCode.UNEXPECTED, _alarm(ending.reason, str(failure)))
        return ending


def _alarm(reason: str, failure: str) -> str:
    return (
        f"{reason}; THE SAFE VOLTAGE COULD NOT BE DRIVEN ({failure}): "
        "cut the air supply, then try `pamctl safe`"
    )
