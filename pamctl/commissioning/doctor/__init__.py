"""Are PC, device and rig fit for a run? Each check gives a finding with its fix.

A finding is a `DoctorFinding` (`hal/doctor_finding.py`); a backend brings the checks of its device.
Read `examination.py` first: it puts all checks in order, from the PC to the muscle.
"""
