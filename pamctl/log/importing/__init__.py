"""Import measurements of other systems: each column is converted to SI.

    csv_table, mat_table, lab_files -> headers, column_map
    -> plausibility -> resample -> imported_log

Read `pipeline.py` first.
"""
