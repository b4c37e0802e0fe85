"""The command line: each verb is one record and one function. No work is done here.

Read `verbs.py` first, then `app.py`.
"""
