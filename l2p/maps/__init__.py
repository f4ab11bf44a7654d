"""Maps: scenes, line clouds, recoveries and truths as plain data."""

from typing import Literal, TypeAlias

#: Attributes that can be published beside the lines, in the order in which they are named to users.
ATTRIBUTES = ("rgb", "descriptor")
#: The same as a type, for completion in editors.
AttributeName: TypeAlias = Literal["rgb", "descriptor"]
