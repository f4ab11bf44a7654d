"""Pictures: what a camera would have seen, computed from points with colours or descriptors."""
