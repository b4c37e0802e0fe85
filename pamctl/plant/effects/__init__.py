"""What the paper's model leaves out, one file an effect: parameters, kernels, description.

Read `places.py` (where effects enter), `description.py` (the record), then one effect, for
example `mechanics/cubic_stiffness.py`. A new file here needs no other edit; an outside package
names its own with an entry point of the group `pamctl.effects`. See `pamctl.plant.catalogue`.
"""
