"""Training of the learned attack: ``python -m train``."""
