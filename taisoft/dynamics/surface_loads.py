"""Contact loads on the surface of a body: pressure, traction, state and slip by node and by triangle. NumPy.

A contact with the weights w_i at nodes i has L_a = sum_i w_i lambda_a(x_i) of its force at corner node a of the faces, where
lambda_a is the hat function of flat faces, and with the normal forces f
    p_a = N_a / A_a,   N_a = sum_c L_ca f_c,   A_a = int lambda_a dA over the deformed triangles around a.
On quadratic faces this uses lambda_a = N_a + half of the shape functions of the middles of its edges: those of corners alone have
no area. Middles have the mean of their corners. A uniform pressure so comes out uniform. As a mean over the faces around a node,
p_a would be too small where the pressure bends down; with the mass matrix M_ab = int lambda_a lambda_b dA each pair of corners
exchanges s M_ab (p_a - p_b), which takes that back to second order: the first step of Jacobi's method for M p = N. s <= 1 lets no
corner lose more than half of its load, which takes its friction and slip along: sums stay, and no friction exceeds its limit.
Beside an edge of the body, A_a counts only triangles that face what presses there. Where that covers a part of them, p_a is a
mean over all. A triangle's force is that of its corners, divided by area: sums over nodes, over triangles and over contacts are
the same.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from taisoft.collision.contacts import STATES
from taisoft.contact.prox import OPEN, SLIP, STICK
from taisoft.display import short_repr
from taisoft.dynamics.readout import ContactRows
from taisoft.dynamics.simulation_state import SimulationState

FACING = 0.5  # least cosine between a triangle's normal and the mean direction that presses on its node


@dataclass(frozen=True, eq=False)
class ContactPressure:
    """What contacts do to a body's surface in the last step, or its last substep, by node or by triangle, arrays (n, ...).

    The sum of `force` is that of -pressure * area along the contacts' normals and traction * area across them; at single nodes
    they differ, since pressures are means around corners. A state is that of the contacts which carry most of the normal force.
    """

    index: np.ndarray  #: (n,) nodes of the surface, ascending, or rows of `body.nodes.surface`
    normal: np.ndarray  #: (n,3) unit vectors out of the deformed body; where something presses, of the triangles that it presses
    pressure: np.ndarray  #: (n,) [Pa] of the deformed surface
    traction: np.ndarray  #: (n,3) [Pa] on the body, by friction
    state: np.ndarray  #: (n,) "open", "stick" or "slip"
    slip: np.ndarray  #: (n,3) [m] tangential displacement relative to what it touches, weighted by force; what sticks counts 0
    accumulated_slip: np.ndarray  #: (n,) [m] length of the path of such slips since the start or the last reset
    gap: np.ndarray  #: (n,) [m] mean of the contacts found there, nan without any
    area: np.ndarray  #: (n,) [m^2] deformed; of a node its part of the triangles around, of mid-edge nodes 0: corners have it
    force: np.ndarray  #: (n,3) [N]; of a node as it acts there

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.index)


class _Surface:
    """Hat functions of a body's surface.

    hats: (n, n) of corners (columns) at nodes; means: (t, n) over triangles; around: (n, t), not 0 for the triangles at a node.
    """

    def __init__(self, body):
        self.triangles, n = body.nodes.surface, body.n_nodes
        self.nodes, t = np.unique(self.triangles), len(self.triangles)
        self.hats = sp.identity(n, format="csr")
        if body.order == 2 and body.nodes.embedded is None:
            (a, ab, ca), (_, b, bc), (*_, c) = self.triangles.reshape(-1, 4, 3)[:, :3].transpose(1, 2, 0)
            middles, first = np.unique(np.concatenate([ab, bc, ca]), return_index=True)
            ends = np.concatenate([[a, b], [b, c], [c, a]], axis=1)[:, first]
            kept = np.setdiff1d(np.arange(n), middles)
            rows, columns = np.concatenate([kept, middles, middles]), np.concatenate([kept, *ends])
            self.hats = sp.csr_matrix((np.where(rows == columns, 1.0, 0.5), (rows, columns)), shape=(n, n))
        thirds = sp.csr_matrix((np.full(3 * t, 1.0 / 3.0), (np.repeat(np.arange(t), 3), self.triangles.ravel())), shape=(t, n))
        self.means, self.around = (thirds @ self.hats).tocoo(), thirds.T.tocsr()

    @cached_property
    def at_corners(self) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """Values (3 t, n) of hats at the corners of triangles, and those plus their sum over the triangle."""
        at = self.hats[self.triangles.ravel()]
        return at, at + sp.kron(sp.identity(len(self.triangles)), np.ones((3, 3)), format="csr") @ at


@dataclass(frozen=True, eq=False)
class _Loads:
    """Loads on one body. contact: (k,) rows of its contacts, twice where it touches itself; hats: (k, n) L; area: (n,) A_a."""

    surface: _Surface
    contact: np.ndarray
    hats: sp.csr_matrix
    force: np.ndarray  # (n,3) on the nodes [N]
    gap: np.ndarray  # (n,) [m]
    sums: np.ndarray  # (n,11) at corners: N_a, its part that slips, friction [N], slip times normal force [N m], -normal times it
    area: np.ndarray
    triangle_area: np.ndarray
    triangle_normal: np.ndarray
    shares: sp.csr_matrix  # (t, n): part of A_a within each triangle [m^2]

    def sharpened(self) -> np.ndarray:
        """Return the sums (n,11) after corners have exchanged what the mean over the faces around them takes, see above."""
        area, load = np.where(self.area > 0.0, self.area, 1.0), self.sums[:, 0]
        at, beside = self.surface.at_corners
        weight = np.repeat(self.triangle_area * (self.shares.sum(axis=1).A1 > 0.0) / 12.0, 3)
        pair = (at.T @ sp.diags(weight) @ beside).tocoo()
        a, b, pressure = pair.row, pair.col, load / area
        used = (load[a] > 0.0) & (load[b] > 0.0) & (pressure[a] > pressure[b])
        a, b, mass = a[used], b[used], pair.data[used]
        lost = np.bincount(b, mass * (pressure[a] - pressure[b]), len(load))
        share = mass * (pressure[a] - pressure[b]) * np.minimum(1.0, 0.5 * load / np.maximum(lost, 1e-300))[b] / load[b]
        moved = sp.csr_matrix((share, (a, b)), shape=self.hats.shape[1:] * 2)  # parts of the load at b that a has
        return self.sums + moved @ self.sums - np.asarray(moved.sum(axis=0)).T * self.sums


class SurfaceLoads:
    """Contact loads on the bodies of a simulation.

    rows of contacts are those before dependent nodes were replaced, so that skins and rigid bodies have loads at their own nodes;
    duration [s]: in which their impulses acted.
    """

    def __init__(self, simulation: SimulationState):
        self._simulation, self._surfaces = simulation, {}

    def tributary_areas(self, rows: ContactRows, duration: float) -> np.ndarray:
        """Return the part (k,) [m^2] of the loaded surface that each contact carries, on the side where it is smaller."""
        areas, normal = np.full(len(rows.gap), np.inf), _normal_forces(rows, duration)
        for k in np.unique(rows.collider[normal > 0.0]):
            if k < len(self._simulation.scene.bodies):
                one = self._loads(k, rows, duration)
                load = one.sums[:, 0]
                part = one.hats @ np.divide(one.area, load, out=np.zeros_like(load), where=load > 0.0) * normal[one.contact]
                np.minimum.at(areas, one.contact, part)
        return np.where(np.isfinite(areas), areas, 0.0)

    def pressure(self, k: int, by_triangle: bool, rows: ContactRows, duration: float) -> ContactPressure:
        """Return the record of body k by node or by triangle."""
        one = self._loads(k, rows, duration)
        surface, slid = one.surface, self._accumulated(k, one.surface)
        if by_triangle:
            index, area = np.arange(len(surface.triangles)), one.triangle_area
            at_corner = one.shares @ sp.diags(1.0 / np.where(one.area > 0.0, one.area, 1.0))
            sums, normal, corners = at_corner @ one.sharpened(), one.triangle_normal, surface.triangles
            force, slid, gap = at_corner @ (surface.hats.T @ one.force), slid[corners].mean(axis=1), one.gap[corners].mean(axis=1)
            density = sums / np.maximum(area, 1e-300)[:, None]
        else:
            index, area, gap = surface.nodes, one.area, one.gap
            at_node = surface.hats.multiply(surface.around @ one.shares > 0.0)  # not beyond edges of what is pressed
            density = at_node @ np.divide(one.sharpened(), area[:, None], out=np.zeros_like(one.sums), where=area[:, None] > 0.0)
            sums, normal, force = at_node @ one.sums, at_node @ (one.shares.T @ one.triangle_normal), one.force
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        load, slipping, slip = sums[:, 0], sums[:, 1], sums[:, 5:8]
        state = np.where(load <= 0.0, OPEN, np.where(2.0 * slipping >= load, SLIP, STICK))
        slip = np.divide(slip, load[:, None], out=np.zeros_like(slip), where=load[:, None] > 0.0)
        every = normal, density[:, 0], density[:, 2:5], np.array(STATES, dtype=object)[state], slip, slid, gap, area, force
        return ContactPressure(index, *(values[index] for values in every))

    def _accumulated(self, k: int, surface: _Surface) -> np.ndarray:
        """Return the accumulated slip (n,) [m] of body k: of dependent nodes from those that they depend on, and of corners of
        quadratic faces, which carry no uniform pressure, the mean of the middles around them that have slipped."""
        simulation, slid = self._simulation, self._simulation.now.slip.to_numpy()[:, None]
        if simulation.dependents is not None:
            simulation.dependents.place(slid)
        slid = slid[simulation.layout.nodes(k), 0]
        middles = sp.tril(surface.hats, k=-1).T
        around = middles @ (slid > 0.0).astype(np.float64)
        return np.divide(middles @ slid, around, out=slid.copy(), where=around > 0.0)

    def _loads(self, k: int, rows: ContactRows, duration: float) -> _Loads:
        """Return the loads on body k."""
        simulation = self._simulation
        if k not in self._surfaces:
            self._surfaces[k] = _Surface(simulation.scene.bodies[k])
        surface, own, half = self._surfaces[k], simulation.layout.nodes(k), rows.nodes.shape[1] // 2
        contact, on_b = np.nonzero(rows.collider == k)
        side = half * on_b[:, None] + np.arange(half)
        node, weight = (np.take_along_axis(values[contact], side, axis=1) for values in (rows.nodes, rows.weights))
        row, column = np.nonzero((node >= own.start) & (node < own.stop))
        shape = len(contact), own.stop - own.start
        weights = sp.csr_matrix((weight[row, column], (row, node[row, column] - own.start)), shape=shape)
        hats, sign, load = weights @ surface.hats, 1.0 - 2.0 * on_b[:, None], _normal_forces(rows, duration)[contact, None]
        force = sign * rows.impulse[contact] / (duration or 1.0)
        inward, slips = sign * rows.normal[contact], rows.state[contact, None] == SLIP
        sums = hats.T @ np.hstack(
            [load, load * slips, force - load * inward, load * slips * sign * rows.slip[contact], -load * inward]
        )
        near = abs(weights)
        with np.errstate(invalid="ignore"):
            gap = near.T @ rows.gap[contact] / np.asarray(near.sum(axis=0)).ravel()
        x = simulation.state()[0][own].astype(np.float64)[surface.triangles]
        normal = 0.5 * np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        area = np.linalg.norm(normal, axis=1)
        normal /= np.maximum(area, 1e-300)[:, None]
        shares = _shares(surface, area, normal, sums[:, 8:], sums[:, 0])
        of_nodes = np.asarray(shares.sum(axis=0)).ravel()
        return _Loads(surface, contact, hats, weights.T @ force, gap, sums, of_nodes, area, normal, shares)


def _normal_forces(rows: ContactRows, duration: float) -> np.ndarray:
    return (rows.impulse * rows.normal).sum(axis=1) / (duration or 1.0)


def _shares(surface: _Surface, area: np.ndarray, normal: np.ndarray, pressed: np.ndarray, load: np.ndarray) -> sp.csr_matrix:
    """Return the part of A_a in each triangle (t, n) [m^2]: of those that face what presses there, or of all if none does.

    pressed: (n,3) sums of outward normals times normal forces [N]; load: (n,) those of the forces.
    """
    means = surface.means
    along = np.einsum("ei,ei->e", normal[means.row], pressed[means.col])
    facing = along >= FACING * np.linalg.norm(pressed, axis=1)[means.col]
    n_facing = np.bincount(means.col, facing, means.shape[1])
    kept = facing | (load[means.col] <= 0.0) | (n_facing[means.col] == 0)
    return sp.csr_matrix((means.data * area[means.row] * kept, (means.row, means.col)), shape=means.shape)
