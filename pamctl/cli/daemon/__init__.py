"""The daemon's verb and those of its clients: start, stop, goto, watch and so on.

Each needs Linux. Read `orders.py` first: a verb is made of its order.
"""
