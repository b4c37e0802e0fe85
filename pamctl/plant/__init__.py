"""The model of muscle and valve: the paper's two blocks, and the effects that it leaves out.

Read `paper/`, then `effects/` (one file an effect), then `step.py`, which composes both.
`catalogue.py` finds the effects, `chains.py` composes them, `drive.py` runs them for fits.
"""
