"""The page of a diagnosis, part by part.

Read `diagnosis_page.py` first.
"""
