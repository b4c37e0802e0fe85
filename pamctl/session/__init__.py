"""Many runs of one rig: asked for from Python, or by the diagnosis itself.

`import pamctl` offers the public names, `pamctl.connect()` and `pamctl.simulate()` first, and loads
them when they are first used: steered_rig, daemon_rig, simulated_rig, run.

    on the rig  `pamctl diagnose --on-rig`: run, diagnose, run the program that decides, until one
                explanation is left or nothing separates the rest: rig_plan, decide_on_rig

Read `steered_rig.py` first.
"""
