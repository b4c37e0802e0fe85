"""The NI PCI-6221: valve on an analog output, pressure on an analog input, encoder on a counter.

`on_demand.py` is paced by the computer, `hardware_timed.py` by the card's own clock.
Read `on_demand.py` first, then `tasks.py`; `nidaq_backend.py` is the record.
"""
