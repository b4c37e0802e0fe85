"""The search for missing effects: score, shortlist, refit, rivals, verdict.

Sets of effects grow by one effect at a time until every block is at its floor.
Read `search.py` first, then `rivals.py` and `verdict.py`; the step `name.py` calls them.
"""
