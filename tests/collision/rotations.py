"""Rotations for tests."""

import numpy as np


def rotation(axis, angle: float) -> np.ndarray:
    """(3,3): by an angle [rad] about an axis (3,) of any length. Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
