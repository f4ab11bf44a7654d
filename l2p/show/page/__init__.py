"""HTML pages: the report of an audit and the view of a file, each a single file that needs no network."""

#: Most points per cloud in a view, by default: a few milliseconds per frame, half a megabyte per layer.
MOST_POINTS = 30_000
