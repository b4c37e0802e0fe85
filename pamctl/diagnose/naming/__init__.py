"""Which effects are missing: shortlist, refit, held-out choice, rivals, verdict.

Sets of effects grow one at a time until every block is at its floor.
Read `search.py` first, then `rivals.py` and `verdict.py`.
"""
