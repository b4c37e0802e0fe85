"""The same PCI-6221 on a stock Linux kernel: the driver `ni_pcimio`, reached through libcomedi.

Tested over stand-ins only: no card has been seen.
Read `comedi_rig.py` first, then `libcomedi.py` (the library) and `comedi_backend.py` (the record).
"""
