"""The model of muscle and valve: the paper's two blocks, and the effects that it leaves out.

`paper/` is the model as printed; `effects/` holds what it leaves out, one file an effect.
`catalogue.py` finds the effects, `chains.py` composes them, `drive.py` runs them for fits.
Read `step.py` first, then `model.py`.
"""
