"""What is missing from a plant, by evidence: one pool, one likelihood, one search, one ladder.

Read `weigh.py` first: it is the door. Then `pool.py` (what may be missing), `run_pieces.py` (what a
plant would have shown), `likelihood.py`, `fit.py`, `scores.py`, `name_search.py`, `ladder.py`; all
that decides stands in `constants.py`.
"""

from pamctl.diagnose.evidence.weigh import EvidenceVerdict, weigh_evidence

__all__ = ["EvidenceVerdict", "weigh_evidence"]
