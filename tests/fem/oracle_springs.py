"""Springs, tendons and attachments once more, from their definitions: where their points are, and their energy, in NumPy.

Points are found by trying every tet, stiffness by the complex step; nothing is shared with the package.
"""

import numpy as np

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def shape_row(body, point: np.ndarray) -> np.ndarray:
    """Weights (n_nodes,) of a body's nodes that give a point (3,) of the body at rest."""
    best, found = -np.inf, None
    for tet in body.mesh.tets:
        corners = np.column_stack([body.mesh.vertices[tet], np.ones(4)])
        own = np.linalg.solve(corners.T, np.append(point, 1.0))
        if own.min() > best:
            best, found = own.min(), (tet, own)
    (tet, own), row = found, np.zeros(body.n_nodes)
    if body.order == 1:
        row[tet] = own
        return row
    row[tet] = own * (2 * own - 1)
    for a, b in EDGES:
        middle = body.mesh.vertices[tet[[a, b]]].mean(axis=0)
        row[np.argmin(np.linalg.norm(body.rest_positions - middle, axis=1))] += 4 * own[a] * own[b]
    return row


class OracleSprings:
    """Elements (row (n,), offset (3,), stiffness, rest length, damping, tension) of all connections of a scene, by name.

    elastic: of each elastic tendon (rows, offsets) of its segments, stiffness and length.
    """

    def __init__(self, scene):
        self.scene, self.elements = scene, {}
        self.first = dict(zip((b.name for b in scene.bodies), np.cumsum([0, *(b.n_nodes for b in scene.bodies)])))
        self.n = sum(body.n_nodes for body in scene.bodies)
        for one in scene.springs:
            ends = [self.point(p.owner, p.position) for p in one.points]
            length = one.rest_length
            if length is None:
                length = np.linalg.norm(self.start(*ends[0]) - self.start(*ends[1]))
                length = 0.0 if length < 1e-12 else length
            self.elements[one.name] = [self.between(*ends, one.stiffness, length, one.damping, 0.0)]
        self.elastic = {}
        for one in scene.tendons:
            tension, ends = float(one.value), [self.point(p.owner, p.position) for p in one.points]
            if one.stiffness is not None:
                segments = [(p[0] - q[0], p[1] - q[1]) for p, q in zip(ends, ends[1:])]
                self.elastic[one.name] = (segments, one.stiffness, float(one.value))
                continue
            self.elements[one.name] = [self.between(p, q, 0.0, 0.0, 0.0, tension) for p, q in zip(ends, ends[1:])]
        for one in scene.attachments:
            a = scene.body(one.a)
            made = []
            for node in one.nodes:
                own = self.point(a.name, a.rest_positions[node])
                place = a.rest_positions[node] + a.position
                if one.b in self.first:
                    place = place - scene.body(one.b).position
                made.append(self.between(own, self.point(one.b, place), one.stiffness, 0.0, one.damping, 0.0))
            self.elements[one.name] = made

    def point(self, owner: str, position):
        row = np.zeros(self.n)
        if owner not in self.first:
            return row, np.array(position)
        body = self.scene.body(owner)
        row[self.first[owner] : self.first[owner] + body.n_nodes] = shape_row(body, np.array(position))
        return row, np.zeros(3)

    def start(self, row, offset):
        rest = np.concatenate([body.rest_positions + body.position for body in self.scene.bodies])
        return row @ rest + offset

    @staticmethod
    def between(p, q, *numbers):
        return (p[0] - q[0], p[1] - q[1], *numbers)

    @property
    def all(self) -> list:
        """Elements of all connections, without those between two obstacles, which move nothing."""
        return [one for own in self.elements.values() for one in own if np.any(one[0])]

    def energy(self, x) -> float:
        """sum k (l - L)^2 / 2 + T l [J]; x may be complex."""
        total = 0.0
        for row, offset, k, length, _, tension in self.all:
            e = row @ x + offset
            if length == 0.0 and tension == 0.0:
                total += 0.5 * k * (e @ e)
            else:
                l = np.sqrt(e @ e)
                total += 0.5 * k * (l - length) ** 2 + tension * l
        return total + sum(0.5 * self.tension(name, x) ** 2 / k for name, (_, k, _) in self.elastic.items())

    def tension(self, name: str, x):
        """Tension [N] of an elastic tendon; x may be complex."""
        segments, k, length = self.elastic[name]
        stretch = sum(np.sqrt(e @ e) for e in (row @ x + offset for row, offset in segments)) - length
        return k * stretch if np.real(stretch) > 0.0 else 0.0 * stretch

    def force(self, x, v=None) -> np.ndarray:
        """Forces (n,3) [N], with damping if there are velocities; x may be complex."""
        f = np.zeros((self.n, 3), dtype=x.dtype)
        for row, offset, k, length, c, tension in self.all:
            e, rate = row @ x + offset, np.zeros(3) if v is None else row @ v
            if length == 0.0 and tension == 0.0:
                f -= np.outer(row, k * e + c * rate)
            else:
                l = np.sqrt(e @ e)
                f -= np.outer(row, (k * (l - length) + tension + c * (rate @ e) / l) * e / l)
        for name, (segments, *_) in self.elastic.items():
            for row, offset in segments:
                e = row @ x + offset
                f -= self.tension(name, x) * np.outer(row, e / np.sqrt(e @ e))
        return f

    def stiffness(self, x) -> np.ndarray:
        """-df/dx (3n,3n) [N/m] without damping, by the complex step."""
        steps = 1e-30j * np.eye(3 * self.n).reshape(-1, self.n, 3)
        return np.column_stack([-np.imag(self.force(x + step)).reshape(-1) / 1e-30 for step in steps])

    def damping(self, x) -> np.ndarray:
        """-df/dv (3n,3n) [N s/m]; forces are linear in v."""
        zero, units = self.force(x), np.eye(3 * self.n).reshape(-1, self.n, 3)
        return np.column_stack([(zero - self.force(x, v)).reshape(-1) for v in units])
