"""Step 4, extend: the plant to go on with, with the named effects and the fitted numbers.

On request, what no effect explains is added as a table. The table is no cause. It stays out
where it does not make the held-out gap smaller.
"""

from __future__ import annotations

from dataclasses import dataclass

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import stack_residuals
from pamctl.diagnose.fitting.evidence import SMALLEST_MISFIT, Evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.held_out_rms import simulate_held_out
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.fitting.table_fit import fit_correction_table
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.plant.model import PlantSettings

LEAST_GAIN = 0.05
"""A table that reduces the held-out RMS of its block by a smaller share is left out."""


def extend_plant(verdict: Verdict, model: Model) -> PlantSettings:
    """Return the plant to go on with under this verdict."""
    if verdict is Verdict.NO_DISCREPANCY:
        return model.evidence.nominal
    return assemble_plant(model)


def assemble_plant(model: Model) -> PlantSettings:
    """Put the fits of the blocks together; where the geometry differs, the mechanics' counts."""
    fixed = {name: value for effect in model.effects for name, value in effect.fixed_numbers}
    return with_values(model.evidence.nominal, {**model.values, **fixed})


@dataclass(frozen=True)
class CorrectionResult:
    """Whether tables were added to the plant, and what they do to the gap."""

    plant: PlantSettings
    """With the tables that help; unchanged where none does."""
    blocks: tuple[str, ...]
    """Blocks that have a table now."""
    why: str
    """The reason, in words."""
    before: dict[str, float]
    """RMS of the held-out gap without the table, by channel, in SI."""
    after: dict[str, float]
    """The same with the table; equal where it was left out."""

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        gap = {
            name: {"before": self.before[name], "after": self.after[name]} for name in self.after
        }
        return {"applied": bool(self.blocks), "blocks": [*self.blocks], "why": self.why, "gap": gap}


def add_correction_tables(
    model: Model, plant: PlantSettings, confirming: Evidence
) -> CorrectionResult:
    """Add a table to `plant` for each block that `model` leaves above its limit.

    The choice is made on the model's evidence, the figures rest on `confirming`.
    """
    evidence = model.evidence
    before = simulate_held_out(evidence, plant)
    kept, blocks, refused = plant, [], []
    for block in model.unexplained:
        table = fit_correction_table(evidence.train[block], kept)
        left = [rms(stack_residuals(evidence.holdout[block], p)) for p in (kept, table)]
        if left[1] <= (1.0 - LEAST_GAIN) * left[0]:
            kept = table
            blocks.append(block)
        else:
            refused.append(
                f"a table for the {block} leaves {left[1] / left[0]:.2f} times what was left "
                "of the held-out records"
            )
    after = simulate_held_out(evidence, kept)
    old, new = before.measure_rms(evidence), after.measure_rms(evidence)
    if worse := [name for name in new if new[name] > old[name] + SMALLEST_MISFIT[name]]:
        refused = [f"tables for {' and '.join(blocks)} make the coupled gap of {worse[0]} larger"]
        kept, blocks, after = plant, [], before
    why = "; ".join([*(f"a table for the {b} is in the model" for b in blocks), *refused])
    figures = (errors.measure_rms(confirming) for errors in (before, after))
    return CorrectionResult(kept, tuple(blocks), why, *figures)
