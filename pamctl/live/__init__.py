"""Watch a run or the daemon: terminal, browser, Foxglove. Nothing here can slow the loop.

Read `feed.py` first.
"""
