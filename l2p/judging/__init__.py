"""How good a recovery is: errors, confidence, neighbours, bounds."""

#: Neighbours and standard deviations of each pass of the outlier removal (Chelani et al., CVPR 2021, reference code).
CLEANING = ((50, 2.0), (25, 2.0))
