"""From the tick to the file: no row that the loop has put is lost, whichever process dies.

The loop puts rows into the ring; the recorder drains the ring into the log.
Read `ring.py` first, then `recorder.py` and `drain.py`.
"""
