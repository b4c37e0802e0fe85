"""Rigs in which an effect is hidden, and the cases that `pamctl diagnose` is examined on.

Nothing here knows `pamctl.plant`: the equations were written again from the paper, with another
integrator, another step and partly other forms of the same effects, so that a mistake made in the
plant cannot hide in the truth as well.
"""
