"""What the paper's model leaves out, one file a place: parameters, kernels and record of each.

Read `places.py` (where effects enter), `description.py` (the record), then one effect, for
example `CubicStiffness` in `mechanics.py`. A new record here needs no other edit; an outside
package names its own with an entry point of the group `pamctl.effects`. See
`pamctl.plant.catalogue`.
"""
