"""Kernels: one way from plain Python functions to machine code.

    translate   Python to C: what a kernel may be
    layout      where its numbers lie in memory
    build       C to a library in the user's cache
    calls       call it, or plain Python where there is no compiler

Read `translate.py` first for what a kernel may use, then `calls.py`.
"""
