"""Work on other machines, through Dask.

Read `dask_cluster.py` first.
"""
