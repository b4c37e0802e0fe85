"""A muscle that is not where its encoder shows it: name it again with the pressure it then has.

The mechanics are driven by a simulation of the pressure, for which the measured position is the
muscle's. A play of the encoder is found in the mechanics only; until then the simulated pressure is
wrong at every reversal, where the play acts, and its width comes out too large.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from pamctl.diagnose.finer_steps import name_again
from pamctl.diagnose.fitting.block_fit import FULL, Fit, fit_numbers
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import with_modelled_pressure
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import calibration_of, with_values
from pamctl.diagnose.name import Naming
from pamctl.diagnose.setup.suspect_setup import CheckedSetup
from pamctl.plant.catalogue import CATALOGUE

CLEARLY_WORSE = 1.1
"""The named effects say where the muscle is; that is believed unless the mechanics then leave so
many times more. What they leave scatters by some per cent."""


def name_with_hidden_motion(
    naming: Naming,
    setup: CheckedSetup,
    alone: Fit | None,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> tuple[Naming, CheckedSetup]:
    """Return naming and set-up for the pressure that the muscle's own motion makes.

    `alone` is the fit of the pressure block that drove the mechanics by the shown motion, where one
    did. It may have a nearer form of what is named.
    """
    model = naming.model
    if alone is None or PRESSURE in model.unexplained:
        return naming, setup
    if not any(map(_hides_motion, model.values)):
        return naming, setup
    evidence = setup.base.evidence
    # The mechanics show the geometry better than the pressure does.
    shared = calibration_of(MECHANICS, evidence.nominal)
    known = {n: v for n, v in model.values.items() if n in shared or _hides_motion(n)}
    free = [number for number in alone.free if number.name not in known]
    progress(f"the pressure that the muscle has behind {' and '.join(model.names)}")
    start = with_values(alone.settings, known)
    behind = fit_numbers(evidence.train[PRESSURE], start, free).settings
    driven = with_modelled_pressure(evidence, setup.train, setup.holdout, behind, trusted=True)
    base = weigh_blocks(recalibrate(driven))
    fitted = fit_model(base, model.effects, [model.values], effort=FULL)
    if fitted.rms[MECHANICS] > CLEARLY_WORSE * model.rms[MECHANICS]:
        return naming, setup
    again = name_again(naming, base, fitted, candidates, executor, progress)
    return again, replace(setup, base=base)


def _hides_motion(number: str) -> bool:
    """Tell whether a number's effect is between the muscle and the position that is shown."""
    effect = CATALOGUE.get(number.split(".")[0]) if "." in number else None
    entries = effect.entries if effect else ()
    return any(e.place == "position_reading" and e.undo is not None for e in entries)
