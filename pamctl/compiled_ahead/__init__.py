"""Kernels as machine code in a file: built once per user, loaded without a compiler.

Read `layout.py` first, then `emit.py` (the builder's side) and `library.py` (the loop's side).
"""
