"""The same PCI-6221 on a stock Linux kernel: the driver `ni_pcimio`, reached through libcomedi.

Tested over stand-ins only: no card has been seen. `comedi_rig.py` is the rig: read it
first. `libcomedi.py` is the library, `comedi_backend.py` the record.
"""
