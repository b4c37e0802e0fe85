"""Import measurements of other systems: each column is converted to SI.

    file_formats -> text_table, lab_tables, matlab_tables: a table of any file
    -> header_words, column_roles, column_map: which column is what
    -> plausibility: whether that can be
    -> imported_log, import_page: the log, and the answer

Read `pipeline.py` first.
"""
