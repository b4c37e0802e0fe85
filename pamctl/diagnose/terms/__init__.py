"""What no catalogue has, described: terms of location, operator and driver.

Read `grammar.py` first: it lists the questions. `term_score.py` asks all of them of a residual,
`trials.py` fits the most promising ones in the plant, `describe.py` decides whether one is said.
"""
