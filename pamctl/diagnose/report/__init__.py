"""The results of a diagnosis: JSON document, terminal text, plant file and page.

Nothing here decides anything.
Read `verdict_words.py` first, then `diagnosis_page.py`.
"""
