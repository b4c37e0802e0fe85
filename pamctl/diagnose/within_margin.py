"""What leaves more than noise, though so little that the limit's margin lets it pass.

The smallest effects of interest may be there. So are the errors of any model: only what explains
all of it is said, beside the lengths and scales that explain it too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from pamctl.diagnose.confirm import SILENT, confirm_naming
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.split import keep_for_confirmation
from pamctl.diagnose.name import Naming, name_effects
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.suspect_setup import CheckedSetup
from pamctl.diagnose.setup_beside import hold_against_setups


def name_within_margin(
    naming: Naming,
    setup: CheckedSetup,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Callable[[str], None],
    *,
    is_cut: bool,
) -> tuple[Naming, CheckedSetup]:
    """Return naming and set-up, with what explains a small misfit; unchanged where nothing does.

    A set-up that was corrected is not asked: its own small error is what is left there.
    `is_cut` tells that one part of each record judges what the other part has fitted.
    """
    strict = frozenset(filter(naming.base.leaves_signal_of, naming.base.evidence.blocks))
    if naming.verdict not in SILENT or not strict or setup.findings:
        return naming, setup
    progress(f"{' and '.join(sorted(strict))}: more than noise is left: asking the effects")
    base = replace(naming.base, evidence=replace(naming.base.evidence, strict=strict))
    again = name_effects(base, candidates, executor, progress)
    if not (again.model.effects and _is_at_floor(again)):
        return naming, setup
    judged = replace(setup, base=base)
    again, judged = hold_against_setups(again, judged, candidates, executor, progress)
    confirmed = confirm_naming(again, keep_for_confirmation(again.base.evidence, is_cut=is_cut))
    is_sure = confirmed.naming.verdict in (Verdict.NAMED, Verdict.AMBIGUOUS, *SILENT)
    return (again, judged) if is_sure else (naming, setup)


def _is_at_floor(naming: Naming) -> bool:
    """Tell whether nothing but noise is left of the blocks that had more."""
    model: Model = naming.model
    return all(model.rms[b] <= model.floors[b].usual for b in naming.base.unexplained)
