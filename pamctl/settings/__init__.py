"""From YAML files to validated settings, and from settings to what the tick needs.

Errors name file, line, key, limit and fix.
Read `rig_file.py` for a schema, `resolve.py` for the way there, `build.py` for what comes of it.
"""
