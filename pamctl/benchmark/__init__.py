"""The hidden rigs as a benchmark for any method: `python -m pamctl.benchmark`.

Read `rigs_folder.py` first; what is run lies in the rigs' own package.
"""
