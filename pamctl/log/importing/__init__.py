"""Import measurements of other systems (CSV, MAT): each column is converted to SI.

    csv_table, mat_table -> quantities, column_map -> judge -> resample -> imported_log

Read `pipeline.py` first.
"""
