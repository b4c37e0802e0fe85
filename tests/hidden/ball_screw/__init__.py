"""A ball-screw drive whose numbers are published: EMPS, of Janot, Gautier and Brunot (2019)."""
