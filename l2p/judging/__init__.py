"""Figures of merit of a recovery: errors, confidence, neighbours, bounds."""

#: Neighbours, and limit in standard deviations, of each pass of outlier removal (code of Chelani et al., CVPR 2021).
CLEANING = ((50, 2.0), (25, 2.0))
