"""Work in other processes, here or on other machines through Dask.

Read `worker_processes.py` first.
"""
