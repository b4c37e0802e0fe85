"""The paper's figures and table from this software.

Read `paper_cases.py` first, then `table_iv.py`.
"""
