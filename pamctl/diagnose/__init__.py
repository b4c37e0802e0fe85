"""Find where simulation and measurement disagree, name the missing effect, add it, show it.

audit   what an excitation cannot see or cannot tell apart, before any fit
locate  which block, which regime, how far beyond the floor
name    shortlist, refit, held-out choice, rivals
extend  the model with the effect and its fitted numbers
show    the coupled held-out gap: nominal, recalibrated, extended, floor
"""

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.sentences import sentence, summary
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
