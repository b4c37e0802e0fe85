"""The model of muscle and valve: the paper's two blocks, and the effects that the paper leaves out.

`paper.py` is the model as printed; `effects/` holds the rest, one file a place.
`catalogue.py` finds the effects and composes them, `drive.py` runs them for fits on the steps of
`sample_grid.py`.
Read `step.py` first, then `model.py`.
"""
