"""One self-contained HTML page of a log.

`svg.py` draws, `html_page.py` lays out, one file a section.
Read `compose.py` first.
"""
