"""What is made of a model: compared with a log or with the paper, or carried to other simulators.

    comparison    the plant driven by a log's command, each block alone and both coupled
    reproduction  the paper's figures and table from this software
    fmu           a functional mock-up unit (FMI 3.0): Simulink, Dymola and others can run it

Read `comparison.py` first.
"""
