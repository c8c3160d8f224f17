"""The fibres of a scene's tets on the device, see `laws.fibres`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.fem.laws.fibres import MOST
from taisoft.fem.loads import activation_slots, number_at
from taisoft.fem.model import Layout, Setup
from taisoft.scene.material import FIBRE_NUMBERS
from taisoft.scene.scene import Body, Scene


@dataclass(frozen=True, eq=False)
class FibreTable:
    """Fibres by tet; 0 in bodies without."""

    numbers: Any  # (n_blocks, 7, lanes) f64: direction at rest, then FIBRE_NUMBERS
    slot: Any  # (n_blocks, lanes) i32: of the activation, in Model.amplitudes


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the fibres, if some body has any."""
    if not setup.on["fibres"]:
        return {}
    arena, layout = setup.arena, setup.layout
    slot = np.zeros(layout.tet_start[-1], dtype=np.int64)
    for k, first in activation_slots(setup.scene).items():
        slot[layout.tets(k)] = first + activation_of_tets(setup.scene.bodies[k])
    table = FibreTable(
        numbers=arena.filled("fibres", ti.f64, fibre_table(setup.scene, layout)),
        slot=arena.filled("fibre_slot", ti.i32, slot[layout.tet_of_lane].reshape(-1, layout.lanes)),
    )
    return {"fibres": table}


def activation_of_tets(body: Body) -> np.ndarray:
    """Row (m,) among a body's activations of each tet."""
    has_regions = body.mesh.regions is not None
    return np.searchsorted(body.mesh.region_ids, body.mesh.regions) if has_regions else np.zeros(body.mesh.n_tets, dtype=np.int64)


def start_activation(body: Body) -> np.ndarray:
    """Activation (m,) of the tets of a body with fibres at the start. Raises SimulationError if a path fails."""
    of_regions = [number_at(one, 0.0, f"body {body.name!r}: activation") for one in body.activations]
    return np.array(of_regions)[activation_of_tets(body)]


def fibre_tangent(body: Body, activation: np.ndarray | float) -> np.ndarray:
    """B (m,3,3) [Pa] of the fibres' stress differential B dF a a^T at F = I, for an activation, a number or (m,).

    Fibres that are neither active nor stretched there count as taut.
    """
    k1, k2, T, strain = (np.broadcast_to(body.composition.number(name), body.mesh.n_tets) for name in FIBRE_NUMBERS)
    T, s = activation * T, 1.0 / (1.0 - activation * strain) ** 2
    z = k2 * (s - 1.0) ** 2
    u = np.exp(np.minimum(z, MOST))
    c = 2.0 * s * k1 * (s - 1.0) * u + T
    h = 4.0 * s * s * k1 * u * (1.0 + np.where(z < MOST, 2.0 * z, 0.0)) - T
    return c[:, None, None] * np.eye(3) + h[:, None, None] * body.fibres[:, :, None] * body.fibres[:, None]


def fibre_table(scene: Scene, layout: Layout) -> np.ndarray:
    """Directions and numbers (n_blocks, 7, lanes) of all tets."""
    table = np.zeros((layout.tet_start[-1], 3 + len(FIBRE_NUMBERS)))
    for k, body in enumerate(scene.bodies):
        if body.fibres is not None:
            table[layout.tets(k), :3] = body.fibres
            for c, name in enumerate(FIBRE_NUMBERS, 3):
                table[layout.tets(k), c] = body.composition.number(name)
    return layout.blocks(table[layout.tet_of_lane])
