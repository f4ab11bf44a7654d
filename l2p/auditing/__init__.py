"""The audit of a map and its report."""

#: Shares of the points that are hidden unless others are given, from the whole map to a very sparse one.
FRACTIONS = (1.0, 0.5, 0.1, 0.05)
