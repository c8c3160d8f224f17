"""What a step changes, as one value: repeated and undone attempts, failures and checkpoints copy it.

`SimulationState.now` is the present one: its x and v are the model's, and its `released` is that of the Dirichlet conditions.
Implicit steps keep two more, of the start of the step and of the substep; explicit steps one, of the last good state.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Array, FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.fem.viscosity import copy_history

if TYPE_CHECKING:
    from taisoft.collision.path_check import HeldPassages


@kernel
def copy_nodes(m: ti.template(), x: ti.template(), v: ti.template(), from_x: ti.template(), from_v: ti.template()):
    """Copy positions and velocities (n_nodes)."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        x[i], v[i] = from_x[i], from_v[i]


@kernel
def copy_values(m: ti.template(), to: ti.template(), values: ti.template()):
    """Copy numbers or vectors (n_nodes)."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        to[i] = values[i]


@dataclass(eq=False)
class StepState:
    """A state. Its arrays of numbers belong to it alone, but for `multipliers`, which are replaced and never changed."""

    model: Model
    x: Array  # (n_nodes) 3-vectors f64 [m]
    v: Array  # (n_nodes) 3-vectors f64 [m/s]
    released: np.ndarray  # (n_groups,) bool: groups of prescribed nodes that move freely by now
    multipliers: np.ndarray  # (k,) Lagrange multipliers [Pa] or [N], see `SceneLoads.multipliers`
    flight: np.ndarray  # (n_colliders,) [s^2], see `Rebounds`,
    gravity: np.ndarray  # and gravity (3,) meanwhile [m/s^2]
    history: Array | None = None  # of Maxwell branches, see `fem.viscosity`; None if there are none
    slip: Array | None = None  # (n_nodes) f64: accumulated at contacts [m]; None where nothing can touch
    none_cross: bool = True  # whether no surfaces are known to cross, so that all paths are checked
    misplaced: np.ndarray | None = None  # (k,9), see `Misplacement`; replaced, never changed. None where nothing can touch,
    held: "HeldPassages | None" = None  # as are the passages that the next search adds as contacts

    def another(self, arena: FieldArena, name: str) -> "StepState":
        """Return a copy with arrays of its own, called x_name and v_name; its nodes are at 0."""
        x, v = (arena.vectors(f"{array}_{name}", ti.f64, self.model.n_nodes) for array in "xv")
        own = (numbers.copy() for numbers in (self.released, self.multipliers, self.flight, self.gravity))
        kept = None if self.history is None else arena.field(f"branch_history_{name}", ti.f64, self.history.shape)
        slip = None if self.slip is None else arena.field(f"accumulated_slip_{name}", ti.f64, self.model.n_nodes)
        return StepState(self.model, x, v, *own, kept, slip, self.none_cross)

    def copy_from(self, other: "StepState") -> None:
        """Become equal to another state."""
        self.copy_nodes_from(other)
        self.copy_rest_from(other)

    def copy_nodes_from(self, other: "StepState") -> None:
        """Take over positions and velocities."""
        copy_nodes(self.model, self.x, self.v, other.x, other.v)

    def copy_rest_from(self, other: "StepState") -> None:
        """Take over all but positions and velocities."""
        self.released[:], self.flight[:], self.gravity[:] = other.released, other.flight, other.gravity
        self.multipliers, self.none_cross = other.multipliers, other.none_cross
        self.misplaced, self.held = other.misplaced, other.held
        self.copy_history_from(other)
        if self.slip is not None:
            copy_values(self.model, self.slip, other.slip)

    def copy_history_from(self, other: "StepState") -> None:
        """Take over the history of Maxwell branches, if there are any."""
        if self.history is not None:
            copy_history(self.model, self.history, other.history)

    def snapshot(self) -> dict:
        """Return the state for a checkpoint, where held passages are at the start of a step."""
        x, v = download([self.x, self.v])
        numbers = {name: getattr(self, name).copy() for name in ("released", "multipliers", "flight", "gravity")}
        of_contacts = {} if self.held is None else {"held": self.held.pairs, "misplaced": self.misplaced}
        of_contacts |= {} if self.slip is None else {"slip": self.slip.to_numpy()}
        return {"x": x, "v": v, "none_cross": self.none_cross} | numbers | of_contacts
