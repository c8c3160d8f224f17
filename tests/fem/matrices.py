"""3x3 matrices that decompositions and laws fail on, by kind."""

import numpy as np


def rotations(rng, n: int) -> np.ndarray:
    Q = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    return Q * np.linalg.det(Q)[:, None, None]


def stretched(rng, s, n: int = 400) -> np.ndarray:
    """Matrices (n,3,3) with the signed singular values s."""
    return rotations(rng, n) @ (np.broadcast_to(s, (n, 3))[..., None] * rotations(rng, n))


def hard_matrices() -> dict[str, np.ndarray]:
    """kind -> matrices (k,3,3)."""
    rng = np.random.default_rng(7)
    random = rng.standard_normal((800, 3, 3))
    e = 10.0 ** rng.uniform(-8, 3, 400)
    return {
        "random": random,
        "identity": np.eye(3)[None] * np.array([1.0, 3.0, 1e-3])[:, None, None],
        "diagonal": random * np.eye(3),
        "all alike": stretched(rng, (1, 1, 1)),
        "nearly alike": stretched(rng, (1 + 1e-4, 1, 1 - 1e-5)),
        "two alike": stretched(rng, (2, 0.5, 0.5)),
        "reflections": stretched(rng, (1, 1, -1)),
        "inverted": stretched(rng, (2, 1, -0.1)),
        "nearly inverted": stretched(rng, (1.2, 0.9, 1e-3)),
        "rank 2": rng.integers(-3, 4, (400, 3, 2)) @ rng.integers(-3, 4, (400, 2, 3)),
        "rank 1": stretched(rng, (2, 0, 0)),
        "integer rank 1": rng.integers(-3, 4, (400, 3, 1)) * rng.integers(-3, 4, (400, 1, 3)),
        "zero": np.zeros((2, 3, 3)),
        "sheared": np.eye(3) + e[:, None, None] * (np.arange(9).reshape(3, 3) == 1),
        "tiny": 1e-6 * random,
        "mixed sizes": np.where(rng.random(random.shape) < 0.5, 1e-6, 1.0) * random,
        "huge": 1e30 * random,
        "stiff, off the diagonal by 1e-30": np.diag([1e9, 1.0, 2.0])[None] + 1.2e-30 * (1.0 - np.eye(3)),
        "stretched 1e-3 to 1e3": stretched(rng, 10.0 ** rng.uniform(-3, 3, (400, 3))),
        "needles": stretched(rng, (1e3, 1e-3, -1e-3)),
    }


MATRICES = hard_matrices()
