"""The paper's model, Eq. 1 to 9, as printed.

`pressure.py` is one block (u, x -> P), `mechanics.py` the other (P -> x).
Read `muscle.py` and `valve.py` first, then the two blocks.
"""
