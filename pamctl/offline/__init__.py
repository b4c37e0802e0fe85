"""The tick without a rig: a whole run simulated, or a log run again on its raw samples.

    simulate   settings, plant -> tick and plant, compiled -> columns, figures of merit
    replay     raw samples, measured timing -> tick -> measurement, estimate, command, output
               settings, times              -> program -> reference, zeros

`merit.py` has the figures of merit that all pages and tables use. A replay's inputs are the logged
ones, lateness and durations included: no clock is read. Its tick runs compiled. If its results
differ from the log, plain Python decides, because it made the log.

Read `closed_loop.py` first; for the replay `replay_source.py`, then `tick_replay.py`.
"""
