"""The experiment that decides between the explanations that a diagnosis leaves.

Programs are drawn from the building blocks of an experiment file, and each explanation is simulated
under each. The program is chosen that separates the two nearest explanations best (a T-optimal
design), within the rig's own limits. Read `deciding_program.py` first.
"""
