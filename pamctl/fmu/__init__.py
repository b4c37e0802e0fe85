"""A plant file as a functional mock-up unit (FMI 3.0): Simulink, Dymola and others can run it.

Read `archive.py` first.
"""
