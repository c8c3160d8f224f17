"""Records of a scene in arrays: `Model`, what is constant, with its `State`; `Layout`, where things stand in it; `Setup`.

Structure of arrays over all bodies, elements in blocks of SIMD lanes. Kernels are compiled for laws, orders, flags and precision.
Topology, rest shape and sizes are constant but run-time data, as are gravity, material numbers, loads and constraint masks.
Nodes keep the order of the bodies and of their meshes. `build.build_model` makes a model.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.lists import spread_on
from taisoft.backend.runtime import Runtime
from taisoft.backend.team import Team
from taisoft.fem.chunks import FOLDED, SweepOrder
from taisoft.fem.dependent_table import DependentTable
from taisoft.fem.spring_table import SpringTable
from taisoft.fem.state import State
from taisoft.scene.scene import Scene


@dataclass(frozen=True)
class Group:
    """Blocks of one element type and law, and the offsets of their data in the flat arrays."""

    law: Any  # of taisoft.fem.laws, or WithAdditions
    order: int
    n_nodes: int  # of an element
    n_points: int
    mean_dilatation: bool
    rigid: bool  # of rigid bodies, whose strains are as small as the rounding of f32
    curved: bool  # of bodies some of whose edges are curved at rest
    first: Count  # first block
    last: Count  # one past the last block
    nodes_at: Count  # offset in Model.nodes
    force_at: Count  # offset in State.element_force, in vectors of lanes
    matrix_at: Count  # offset in the assembly buffer
    points_at: Count  # first row in Model.points
    curved_at: Count  # first row in Model.curved
    real: Any  # Taichi type of stress
    strain_real: Any  # Taichi type in which the deformation gradient is formed


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """Constant arrays, their sizes (`Count`), structure and the state: one template argument of kernels.

    Fields with a default belong to features, and have it if the feature is off.
    """

    real: Any  # Taichi type of everything but positions
    lanes: int
    serial: bool  # loops run on one thread
    on_cpu: bool
    n_nodes: Count
    n_blocks: Count
    groups: tuple  # of Group
    state: State  # positions, velocities, scratch
    terms: tuple  # modules of fem.terms
    nodes: Any  # i32: nodes of each tet, per block (node, lane); corners, then mid-edge nodes, each ascending
    rules: tuple  # mesh.quadratic.Quadrature of the order 2 groups, in ascending degree
    points: Any = None  # (points, 28): weight and dN_a/d(l_1, l_2, l_3) of nodes 1 to 9 at the points of these rules
    curved: Any = None  # (rows, 10, lanes), by block and point: Dm^-1 there [1/m], `lanes.volume_ratio_at`
    Dm_inv: Any  # (n_blocks, 9, lanes) [1/m]
    volume: Any  # (n_blocks, lanes) [m^3]
    block_body: Any  # (n_blocks) i32
    law_constants: Any  # (n_bodies, 4), or (n_blocks, 4, lanes) if elasticity_by_tet; 6 numbers if some body has a volume floor
    gather_start: Any  # (n_nodes + 1) i32: first entry of each node in gather_entry
    gather_entry: Any  # i32: base index into State.element_force of each node of each tet
    mass: Any  # (n_nodes) lumped mass [kg]
    gravity_mass: Any  # (n_nodes) mass used for weight [kg]: the lumped mass, or int rho N_a dV
    mass_matrix: Any = None  # fem.masses.MassMatrix
    free: Any  # (n_nodes) 3-vectors: 1 on free axes, 0 on constrained ones
    gravity: Any  # () 3-vector [m/s^2]
    springs: Any = None  # fem.springs.Springs
    dependents: Any = None  # fem.dependents.Dependents
    most_masters: Count = 1  # largest number of nodes that a node depends on
    loads: Any = None  # (n_nodes) 3-vectors [N]: tractions and forces
    amplitudes: Any = None  # f64: present values of the loads that are one number, see `fem.loads.scalar_loads`
    pressure: Any = None  # fem.pressure.PressureTable
    rigid_tets: Any = None  # fem.rigid_tets.RigidTets, to be damped, or moved as rigid bodies
    node_body: Any = None  # (n_nodes) i32; for damping
    damping: Any = None  # (n_bodies, 2): mass damping [1/s], stiffness damping [s]
    has_springs: bool = False  # or tendons or attachments
    has_dependents: bool = False
    has_rigid_tets: bool = False
    consistent: bool = False  # mass_matrix is used
    loaded: bool = False
    damped: bool = False
    stiffness_damping: bool = False
    spring_damping: bool = False
    mean_dilatation: bool = False  # of some group
    mean: Any = None  # fem.mean_dilatation.MeanDilatation
    fibres: Any = None  # fem.fibres.FibreTable
    viscosity: Any = None  # fem.viscosity.Viscosity
    elasticity_by_tet: bool  # law_constants may differ between the tets of a body
    team: Team  # of loops over sums and springs
    chunks: int  # of a loop, each with its own partial sums

    @property
    def spread(self) -> int:
        """Iterations of a loop per chunk, see `backend.lists`."""
        return spread_on(self.on_cpu, self.serial)

    @property
    def sums(self) -> int:
        """Partial sums that `fem.chunks.total_by_team` adds."""
        return self.chunks if self.on_cpu else min(self.chunks, FOLDED)

    @property
    def sweep(self) -> SweepOrder:
        """Order of a Gauss-Seidel sweep, which is divided in scenes whose loops are, on the CPU."""
        return SweepOrder.of(self.n_nodes) if self.on_cpu and self.chunks > 1 else SweepOrder()

    @property
    def viscous(self) -> bool:
        """Whether some law has Maxwell branches."""
        return self.viscosity is not None

    @property
    def depends_on_velocity(self) -> bool:
        """Whether forces other than mass damping depend on velocities."""
        return self.stiffness_damping or self.spring_damping


@dataclass(frozen=True)
class Layout:
    """Host-side index ranges of bodies and tets in the model, and the tables of its connections."""

    node_start: np.ndarray  # (n_bodies + 1)
    tet_start: np.ndarray  # (n_bodies + 1), among the tets of all bodies
    tet_of_lane: np.ndarray  # (n_blocks * lanes,) tet among those of all bodies; padding repeats the tet before it
    lane_of_tet: np.ndarray  # (n_tets,) its lane, counted through all blocks
    rest: np.ndarray  # (n_nodes, 3) rest positions in the scene [m]
    lanes: int
    dependents: DependentTable | None
    springs: SpringTable | None

    def nodes(self, body: int) -> slice:
        """Rows of a body's nodes."""
        return slice(self.node_start[body], self.node_start[body + 1])

    def tets(self, body: int) -> slice:
        """Rows of a body's tets."""
        return slice(self.tet_start[body], self.tet_start[body + 1])

    def blocks(self, values: np.ndarray) -> np.ndarray:
        """Values (k * lanes, c) of lanes as blocks (k, c, lanes)."""
        return values.reshape(-1, self.lanes, values.shape[1]).transpose(0, 2, 1)


@dataclass(frozen=True)
class Setup:
    """What a feature makes its fields of Model from, see `build`."""

    scene: Scene
    runtime: Runtime
    arena: FieldArena
    layout: Layout
    on: dict[str, bool]  # the plan's switches; a feature that finds nothing to do turns its own off
