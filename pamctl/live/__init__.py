"""Watch the daemon: terminal, browser. Nothing here can slow the loop.

Read `feed.py` first.
"""
