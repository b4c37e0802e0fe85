"""Find where simulation and measurement disagree, say what is missing, add it, show the gap shrink.

record            a run's columns; `mend` takes off what sensors added, `refuse` what misleads
evidence          the pool of hypotheses, one likelihood, one search, the ladder of names
deciding_program  the program that tells apart what is left open
report            document, sentence, page, plant file

Read `workflow.py` first, then `evidence/weigh.py`.
"""

from pamctl.diagnose.diagnosis import Diagnosis, DiagnosisInterrupted, Verdict
from pamctl.diagnose.read_record import record_of
from pamctl.diagnose.record import Record
from pamctl.diagnose.report.diagnosis_document import report_diagnosis
from pamctl.diagnose.report.verdict_words import sentence
from pamctl.diagnose.workflow import diagnose

__all__ = [
    "Diagnosis",
    "DiagnosisInterrupted",
    "Record",
    "Verdict",
    "diagnose",
    "record_of",
    "report_diagnosis",
    "sentence",
]
