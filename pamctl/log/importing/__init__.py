"""Make logs of what other systems measured: CSV and MAT files, column by column into SI.

    table (csv_table, mat_table) - readings (quantities, mapping) - judge - resample - log

`pipeline.import_log` is the way from one end to the other.
"""
