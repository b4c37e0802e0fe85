"""Look on while it runs: terminal, browser, Foxglove. Nothing here can slow the loop.

Read `feed.py` first.
"""
