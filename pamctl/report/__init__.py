"""Answers: a report is one value, printed by a terminal, by JSON and as a page.

    report -> axes, figure -> picture, html_page
    reported_run -> run_motion, frequency -> run_page

Read `report.py` first.
"""
