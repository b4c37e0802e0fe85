"""The paper's model of the muscle: two blocks, and the catalogue of effects on top.

`paper/` is the model as printed; `effects/` holds what it leaves out, one file an effect.
Read `step.py` first, then `model.py`.
"""
