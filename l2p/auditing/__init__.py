"""The audit of a map and its report."""

#: Default fractions of the points that are lifted, from the whole map to a very sparse one.
FRACTIONS = (1.0, 0.5, 0.1, 0.05, 0.01)

#: Most views of a map whose pictures are on the page, and how many there are by default.
MOST_VIEWS, VIEWS = 6, 3
#: Files of the folder of a report.
PAGE, FIGURES = FILES = ("index.html", "audit.json")
