"""Find where simulation and measurement disagree, name the missing effect, add it, show it.

audit   what an excitation cannot show or cannot tell apart, before any fit
locate  which block, which regime, how far above the floor
name    shortlist, refit, held-out choice, rivals
extend  the model with the effect and its fitted numbers
show    the held-out gap of the coupled model: nominal, recalibrated, extended, floor

Read `workflow.py` first, then the five steps, a file each. The rooms below them: `measured` (the
records), `fitting` (models and their floors), `naming` (the search); above them: `report`.
"""

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.terminal_summary import summary
from pamctl.diagnose.report.verdict_words import sentence
from pamctl.diagnose.workflow import diagnose

__all__ = [
    "Diagnosis",
    "Record",
    "Verdict",
    "diagnose",
    "record_of",
    "sentence",
    "summary",
]
