"""Contact detection: broad-phase candidates, contact geometry, reduction."""
