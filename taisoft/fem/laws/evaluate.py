"""Pointwise evaluation of the laws in float64, for tests, tables and teaching."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel, open_kind, open_runtime
from taisoft.errors import SceneError
from taisoft.fem.laws import dpk1_projected, law_of, prepare_projected
from taisoft.fem.laws.volume_floor import constants as floor_constants
from taisoft.scene.scene import Material

ARRAY = ti.types.ndarray()


@ti.func
def _load(A: ti.template(), b, lanes: ti.template()):
    return [ti.Vector([A[b, k, q] for q in ti.static(range(lanes))]) for k in ti.static(range(9))]


@ti.func
def _store(out: ti.template(), b, A, lanes: ti.template()):
    for k in ti.static(range(9)):
        for q in ti.static(range(lanes)):
            out[b, k, q] = A[k][q]


@kernel
def _evaluate(law: ti.template(), lanes: ti.template(), F: ARRAY, p: ARRAY, psi: ARRAY, P: ARRAY):
    for b in range(F.shape[0]):
        G = _load(F, b, lanes)
        c = [ti.Vector([p[k] for q in ti.static(range(lanes))]) for k in ti.static(range(law.N_CONSTANTS))]
        energy = law.psi(G, c)
        stress = law.pk1(G, c)
        _store(P, b, stress, lanes)
        for q in ti.static(range(lanes)):
            psi[b, q] = energy[q]


@kernel
def _differential(law: ti.template(), projected: ti.template(), lanes: ti.template(), F: ARRAY, p: ARRAY, D: ARRAY, P: ARRAY):
    for b in range(F.shape[0]):
        G = _load(F, b, lanes)
        H = _load(D, b, lanes)
        c = [ti.Vector([p[k] for q in ti.static(range(lanes))]) for k in ti.static(range(law.N_CONSTANTS))]
        if ti.static(projected):
            _store(P, b, dpk1_projected(law, prepare_projected(law, G, c), H), lanes)
        else:
            _store(P, b, law.dpk1(G, law.prepare(G, c), H), lanes)


def _checked(law: str, F: np.ndarray, young: float, poisson: float, floor: float):
    material = Material(law=law, young=young, poisson=poisson, density=1.0, volume_floor=floor)
    F = np.asarray(F, dtype=np.float64)
    if F.ndim != 3 or F.shape[1:] != (3, 3) or len(F) == 0:
        raise SceneError(f"F has shape {F.shape}: it must be (k, 3, 3) with k at least 1")
    bad = np.flatnonzero(~np.isfinite(F).all(axis=(1, 2)))
    if len(bad):
        raise SceneError(f"F[{bad[0]}] is not finite")
    made = law_of(material.law, material.volume_floor > 0.0)
    p = (law_of(law, False).constants(material.mu, material.lam), floor_constants(floor, material.mu, material.lam))
    return made, F, np.concatenate(p)


@contextmanager
def _double_precision() -> Iterator[int]:
    """Open an f64 runtime, or reuse an open one of any arch; yields its number of lanes."""
    kind = open_kind()
    arch = kind[0] if kind and kind[1] == "f64" else "cpu"
    runtime = open_runtime(arch, "f64", "evaluate_law")
    try:
        yield runtime.lanes
    finally:
        runtime.close()


def _to_lanes(values: np.ndarray, lanes: int) -> np.ndarray:
    """Reorder (k, 3, 3) values to (blocks, 9, lanes), repeating the last one as padding."""
    k = len(values)
    blocks = -(-k // lanes)
    padded = np.concatenate([values, np.repeat(values[-1:], blocks * lanes - k, axis=0)])
    return np.ascontiguousarray(padded.reshape(blocks, lanes, 9).transpose(0, 2, 1))


def _from_lanes(data: np.ndarray, k: int) -> np.ndarray:
    return data.transpose(0, 2, 1).reshape(-1, 3, 3)[:k]


def evaluate_law(
    law: str, F: np.ndarray, young: float, poisson: float, volume_floor: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Energy density psi (k,) [Pa], 0 at F = I, and first Piola-Kirchhoff stress P (k,3,3) [Pa], in float64.

    F: (k,3,3) deformation gradients; law, young [Pa], poisson, volume_floor: of a `Material`. Raises SceneError on a bad law,
    number or shape.
    """
    law_module, F, p = _checked(law, F, young, poisson, volume_floor)
    with _double_precision() as lanes:
        lane_F = _to_lanes(F, lanes)
        P, psi = np.empty_like(lane_F), np.empty((len(lane_F), lanes))
        _evaluate(law_module, lanes, lane_F, p, psi, P)
    return psi.reshape(-1)[: len(F)].copy(), _from_lanes(P, len(F)).copy()


def evaluate_differential(
    law: str, F: np.ndarray, dF: np.ndarray, young: float, poisson: float, projected: bool = False, volume_floor: float = 0.0
) -> np.ndarray:
    """Stress differential dP (k,3,3) [Pa] along dF (k,3,3), in float64; projected: use the positive semi-definite part."""
    law_module, F, p = _checked(law, F, young, poisson, volume_floor)
    with _double_precision() as lanes:
        lane_F, D = _to_lanes(F, lanes), _to_lanes(np.array(np.broadcast_to(dF, F.shape), dtype=np.float64), lanes)
        P = np.empty_like(lane_F)
        _differential(law_module, projected, lanes, lane_F, p, D, P)
    return _from_lanes(P, len(F)).copy()
