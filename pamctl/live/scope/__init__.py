"""The scope: every tick of a logged run, searched for a trigger and handed out by columns.

    ring of the run -> tick_memory -> trigger, tick_source -> the page

Read `tick_memory.py` first.
"""
