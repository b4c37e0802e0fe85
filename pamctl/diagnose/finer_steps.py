"""An effect that the simulation's own steps blur: name it again with as many as it needs.

Friction that falls steeply with speed slips within a fraction of a millisecond. With the usual
steps the right effect leaves several times the floor, and seems to explain a part only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import refine_substeps
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate, weigh_blocks
from pamctl.diagnose.name import Naming, name_effects
from pamctl.diagnose.setup.suspect_setup import CheckedSetup

MUCH_NEARER = 0.7
"""More steps are worth their time if the named effects then leave nothing, or less than this share
of the residual of a block."""
MOST_RIVALS = 4
"""Names of the search that are asked again beside the named ones."""


def name_with_finer_steps(
    naming: Naming,
    setup: CheckedSetup,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> tuple[Naming, CheckedSetup]:
    """Return naming and set-up on more sub-steps; unchanged where the usual ones are enough."""
    model = naming.model
    if not (model.effects and model.unexplained):
        return naming, setup
    finer = refine_substeps(model)
    if finer is model.evidence:
        return naming, setup
    progress(f"simulating {' and '.join(model.names)} with finer steps")
    base = weigh_blocks(recalibrate(replace(finer, nominal=setup.base.evidence.nominal)))
    fitted = fit_model(base, model.effects, [model.values], effort=FULL)
    is_near = any(fitted.rms[b] <= MUCH_NEARER * model.rms[b] for b in model.unexplained)
    if not (is_near or fitted.is_complete):
        return naming, setup
    again = name_again(naming, base, fitted, candidates, executor, progress)
    return again, replace(setup, base=base)


def name_again(
    naming: Naming,
    base: Model,
    fitted: Model,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
) -> Naming:
    """Name again near what was named, which is `fitted` on the changed evidence of `base`."""
    model = naming.model
    names = dict.fromkeys(name for trial in naming.trials for name in trial.names)
    asked = {*model.names, *[n for n in names if n not in model.names][:MOST_RIVALS]}
    nearest = [c for c in candidates if c.name in asked]
    return name_effects(base, nearest, executor, progress, (fitted,))
