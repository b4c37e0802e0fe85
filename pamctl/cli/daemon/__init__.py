"""The daemon's verb and those of its clients: start, stop, goto, watch and so on.

Each needs Linux. Read `ask.py` first: it is how every client asks the daemon.
"""
