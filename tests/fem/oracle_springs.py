"""Springs, tendons and attachments once more, from their definitions: where their points are, and their energy, in NumPy.

Points are found by trying every tet, stiffness by the complex step; nothing is shared with the package.
"""

from itertools import pairwise

import numpy as np

from tests.fem.oracle_elements import EDGES


def shape_row(body, point: np.ndarray) -> np.ndarray:
    """Weights (n_nodes,) of a body's nodes that give a point (3,) of the body at rest."""
    corners = np.insert(body.mesh.vertices[body.mesh.tets], 3, 1.0, axis=2)
    weights = np.linalg.solve(corners.swapaxes(1, 2), np.append(point, 1.0)[:, None])[..., 0]
    best = weights.min(axis=1).argmax()
    tet, own, row = body.mesh.tets[best], weights[best], np.zeros(body.n_nodes)
    row[tet] = own if body.order == 1 else own * (2 * own - 1)
    for a, b in EDGES if body.order == 2 else ():
        middle = body.mesh.vertices[tet[[a, b]]].mean(axis=0)
        row[np.argmin(np.linalg.norm(body.rest_positions - middle, axis=1))] += 4 * own[a] * own[b]
    return row


class OracleSprings:
    """All connections of a scene: elements e = row x + offset (m of them), in lines that share a tension.

    energy = sum k (l - L)^2 / 2 + T l over the lines, of length l; those that slacken have none of the first where l < L.
    """

    def __init__(self, scene):
        self.scene, self.elements, self.line, numbers = scene, [], [], []
        self.first = dict(zip((b.name for b in scene.bodies), np.cumsum([0, *(b.n_nodes for b in scene.bodies)])))
        self.n = sum(body.n_nodes for body in scene.bodies)
        rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])

        def add(points, stiffness, length, damping=0.0, tension=0.0, slackens=False) -> None:
            ends = [self.point(*point) for point in points]
            made = [(p[0] - q[0], p[1] - q[1]) for p, q in pairwise(ends) if slackens or p[0].any() or q[0].any()]
            self.elements += made
            self.line += [len(numbers)] * len(made)
            if length is None:
                row, offset = self.elements[-1]
                length = np.linalg.norm(row @ rest + offset).round(12)
            numbers.append((stiffness, length, damping, tension, slackens))

        for one in scene.springs:
            add([(p.owner, p.position) for p in one.points], one.stiffness, one.rest_length, one.damping)
        for one in scene.tendons:
            given = (one.stiffness, float(one.value), 0.0, 0.0, True) if one.stiffness else (0.0, 0.0, 0.0, float(one.value))
            add([(p.owner, p.position) for p in one.points], *given)
        for one in scene.attachments:
            a, b = scene.body(one.a), scene.body(one.b) if one.b in self.first else None
            shift = a.position - (b.position if b else 0.0)
            for place in a.rest_positions[one.nodes]:
                add([(one.a, place), (one.b, place + shift)], one.stiffness, 0.0, one.damping)
        self.rows, self.offsets = (np.array(part) for part in zip(*self.elements))
        self.k, self.L, self.c, self.T, self.slackens = np.array(numbers).T
        self.isotropic = ((self.L == 0) & (self.T == 0))[self.line]
        self.of_line = np.eye(len(numbers))[self.line]

    def point(self, owner: str, position):
        """The row (n,) and offset (3,) of a point."""
        row = np.zeros(self.n)
        if owner not in self.first:
            return row, np.array(position)
        body = self.scene.body(owner)
        row[self.first[owner] : self.first[owner] + body.n_nodes] = shape_row(body, np.array(position))
        return row, np.zeros(3)

    def _lines(self, x):
        """Directions of the elements, and length and stretch of the lines; x may be complex."""
        e = self.rows @ x + self.offsets
        l = np.sqrt((e * e).sum(axis=1))
        stretch = l @ self.of_line - self.L
        return e / np.where(l == 0, 1.0, l)[:, None], l @ self.of_line, np.where(self.slackens * (stretch.real < 0), 0.0, stretch)

    def energy(self, x) -> float:
        """[J]."""
        _, length, stretch = self._lines(x)
        return self.k @ stretch**2 / 2 + self.T @ length

    def force(self, x, v=None) -> np.ndarray:
        """Forces (n,3) [N], with damping if there are velocities; x may be complex."""
        d, _, stretch = self._lines(x)
        pull = (self.k * stretch + self.T)[self.line, None] * d
        if v is not None:
            rate = self.rows @ v
            along = np.where(self.isotropic[:, None], rate, (rate * d).sum(axis=1, keepdims=True) * d)
            pull = pull + self.c[self.line, None] * along
        return -self.rows.T @ pull

    def stiffness(self, x) -> np.ndarray:
        """-df/dx (3n,3n) [N/m] without damping, by the complex step."""
        steps = 1e-30j * np.eye(3 * self.n).reshape(-1, self.n, 3)
        return np.column_stack([-np.imag(self.force(x + step)).reshape(-1) / 1e-30 for step in steps])

    def damping(self, x) -> np.ndarray:
        """-df/dv (3n,3n) [N s/m]; forces are linear in v."""
        zero, units = self.force(x), np.eye(3 * self.n).reshape(-1, self.n, 3)
        return np.column_stack([(zero - self.force(x, v)).reshape(-1) for v in units])
