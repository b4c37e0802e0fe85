"""What happens within a millisecond: the tick, the loop around it, its clock and its ring."""
