"""Commands that were logged more rarely than they were given.

Where a lively command changes only every few rows, the rows between were given too, or were not:
a smooth curve through the logged values decides. Steps between two rows cannot be restored.
"""

from __future__ import annotations

import numpy as np

from pamctl.diagnose.fitting.block_fit import fit_numbers, rms
from pamctl.diagnose.fitting.drives import PRESSURE, Drive, stack_residuals
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspects import Suspect, find_decimation
from pamctl.diagnose.setup.weighed_fit import SuspectFit
from pamctl.plant.model import PlantSettings

LEAST_EXPLAINED = 0.45
"""Share of the square above the floor that the curve must explain, on held-out records too."""


def suspect_decimation(model: Model) -> SetupFinding | None:
    """Return the suspicion that the command was given more often than it was logged.

    For a pressure that nothing explains: what was lost between two rows cannot be asked.
    """
    if PRESSURE not in model.unexplained:
        return None
    commands_v = [d.valve_v for d in model.evidence.train[PRESSURE]]
    lively = [n for n in map(find_decimation, commands_v) if n > 1]
    if not lively or any(_changes_between(v, min(lively)) for v in commands_v):
        return None
    held, ratio = float(min(lively)), model.ratio(PRESSURE)
    return SetupFinding(
        "decimated_command",
        "valve_v",
        held,
        (held, held),
        "samples",
        PRESSURE,
        1.0,
        ratio,
        ("an effect in no catalogue",),
        "log the command at every sample; if the rig does get it so rarely, look elsewhere",
        f"the command changes once in {held:.0f} samples, and the rig may have got it more often",
        is_corrected=False,
    )


def _changes_between(valve_v: Array, held: int) -> bool:
    """Tell whether a command also changes between every `held` rows."""
    return bool(np.any(np.diff(np.flatnonzero(np.diff(valve_v))) % held))


def fit_decimation(base: Model) -> SuspectFit | None:
    """Return the fit with restored commands, where it explains much of the lively records."""
    if PRESSURE not in base.unexplained:
        return None
    train, holdout = (
        [d for d in drives[PRESSURE] if find_decimation(d.valve_v) > 1]
        for drives in (base.evidence.train, base.evidence.holdout)
    )
    if not train or not holdout:
        return None
    held = min(find_decimation(d.valve_v) for d in (*train, *holdout))
    suspect = Suspect(
        "decimated_command", "valve_v", "samples", 1.0, 1e9, (), 1.0, frozenset({PRESSURE})
    )
    fitted, nominal = base.fit_of(PRESSURE), base.evidence.nominal
    as_is = fit_numbers(train, nominal, fitted.free)
    restored = fit_numbers([suspect.apply(d, held) for d in train], nominal, fitted.free)
    floor = base.floors[PRESSURE].mean

    def excess(drives: list[Drive], settings: PlantSettings) -> float:
        return max(rms(stack_residuals(drives, settings)) ** 2 - floor**2, 0.0)

    for drives in (train, holdout):
        before = excess(drives, as_is.settings)
        after = excess([suspect.apply(d, held) for d in drives], restored.settings)
        if not before - after > LEAST_EXPLAINED * before:
            return None
    blocks = next(b for b in base.fits if PRESSURE in b)
    return SuspectFit(base, suspect, float(held), 0.0, {blocks: restored})
