"""Find where simulation and measurement disagree, name the missing effect, add it, show it."""

from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.measured.from_log import record_of
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.workflow import diagnose

__all__ = ["Diagnosis", "Record", "Verdict", "diagnose", "record_of"]
