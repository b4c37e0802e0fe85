"""The paper's figures and table from this software.

Read `reproduction.py` first.
"""
