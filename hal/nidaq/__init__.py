"""The NI PCI-6221: valve on an analog output, pressure on an analog input, encoder on a counter.

Read `nidaq_rig.py` first, then `driver.py` (driver and tasks); `nidaq_backend.py` is the record.
"""
