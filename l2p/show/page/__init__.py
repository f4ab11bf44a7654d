"""Pages to look at: the report of an audit and the view of a file, each one HTML file that needs no network."""

#: Points of each cloud that a view draws unless told otherwise: a few milliseconds a frame, half a megabyte a layer.
MOST_POINTS = 30_000
