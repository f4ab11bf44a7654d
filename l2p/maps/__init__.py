"""Maps: scenes, line clouds, recoveries and truths as plain data."""

#: Attributes that can be published beside the lines, in the order in which they are named to users.
ATTRIBUTES = ("rgb", "descriptor")
