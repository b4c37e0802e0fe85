"""The hidden rigs as a benchmark for any method: records out, verdicts in, a table.

`python -m pamctl.benchmark` is its command line. Read `benchmark_suite.py`, then
`records_folder.py`, `verdict_file.py` and `methods_table.py`.
"""
