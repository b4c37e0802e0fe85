"""A mechanism of one axis without a muscle: how it moves, and the force that it needs.

Read `required_force.py` first.
"""
