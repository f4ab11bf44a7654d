"""Compare methods over scenes, densities and seeds: ``python -m eval``. Predictions are written first, then scored."""
