"""From the tick to the file: nothing that the loop has put is lost, whatever dies.

The loop puts rows into the ring, the recorder drains it into the log.
Read `ring.py` first, then `drain.py` and `finish_from_ring.py`.
"""
