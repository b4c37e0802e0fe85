"""The results of a diagnosis: JSON document, terminal text, plant file and page.

Nothing here decides anything.
Read `sentences.py` first, then `diagnosis_page.py`.
"""
