"""`pamctl report`: one self-contained HTML page of one log or of several.

`drawing/` draws, `html_page.py` lays out, one file a section.
Read `compose.py` first.
"""
