"""Find where simulation and measurement disagree, say what is missing, add it, show the gap shrink.

measured   the records: their columns, what is mended, what must be refused
evidence   the pool of hypotheses, one likelihood, one search, the ladder of place, kind and name
deciding   the program that tells apart what is left open
report     document, sentence, page, plant file

Read `workflow.py` first, then `evidence/weigh.py`.
"""

from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.record import Record
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
