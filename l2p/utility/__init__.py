"""Utility of a release: how well cameras are still localized in it (:func:`l2p.utility.releases.localize`)."""

#: The scheme that publishes points as they are.
POINTS = "points"
#: Ways to match the keypoints of a query with the landmarks of a release.
BY_TRACKS, BY_DESCRIPTORS = MATCHING = ("tracks", "descriptors")
#: Default shares of the points that are published.
FRACTIONS = (1.0, 0.25, 0.1, 0.05, 0.01)
#: Default of the most images that an audit localizes.
MOST_QUERIES = 40
#: Default share of wrong matches.
WRONG = 0.3
