"""Terms: what may be wrong at a place of the plant, said without a name of the catalogue.

    term = location x operator x driver      a force  x  a memory of 1.5 mm  x  the position

A location is a place of the plant (`locations.py`), an operator says how the driver acts
(`operators.py`), a driver is a signal of the plant. One location holds one term. `pamctl diagnose`
finds them where no effect of the catalogue fits; a plant file states them under `terms:`. The
equations of a plant without terms are those of the paper, to the bit. Read `locations.py` first.
"""
