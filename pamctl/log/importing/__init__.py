"""Import measurements of other systems: each column is converted to SI.

    file_formats -> table_rows, cell_texts, parsed_tables, matlab_tables: a table of any file
    -> headers, column_roles, column_map: which column is what
    -> plausibility: whether that can be
    -> pipeline: the log, and the answer

Read `pipeline.py` first.
"""
