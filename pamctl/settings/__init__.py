"""From YAML files to validated settings, and from settings to the parts that the tick needs.

Errors name file, line, key, limit and fix.
Read `resolve.py` first, then `rig_file.py` for a schema and `build.py` for the results.
"""
