"""Pointwise evaluation of the laws in float64, for tests, tables and teaching."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel, open_kind, open_runtime
from taisoft.errors import SceneError
from taisoft.fem.laws import dpk1_projected, lane_law, law_of, n_constants, prepare_projected, volume_floor
from taisoft.scene import checks
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


@ti.func
def _constants(law: ti.template(), p: ti.template(), lanes: ti.template()):
    return [ti.Vector([p[k] for q in ti.static(range(lanes))]) for k in ti.static(range(n_constants(law)))]


@kernel
def _evaluate(law: ti.template(), lanes: ti.template(), F: ARRAY, p: ARRAY, psi: ARRAY, P: ARRAY):
    for b in range(F.shape[0]):
        G = _load(F, b, lanes)
        c = _constants(law, p, lanes)
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
        c = _constants(law, p, lanes)
        if ti.static(projected):
            _store(P, b, dpk1_projected(law, prepare_projected(law, G, c), H), lanes)
        else:
            _store(P, b, law.dpk1(G, law.prepare(G, c), H), lanes)


def _checked(law: str, F: np.ndarray, floor: float, fibre: tuple, **numbers: float | None):
    given = {name: value for name, value in numbers.items() if value is not None}
    material = Material(law=law, volume_floor=floor, **given)
    F = np.asarray(F, dtype=np.float64)
    if F.ndim != 3 or F.shape[1:] != (3, 3) or len(F) == 0:
        raise SceneError(f"F has shape {F.shape}: it must be (k, 3, 3) with k at least 1")
    bad = np.flatnonzero(~np.isfinite(F).all(axis=(1, 2)))
    if len(bad):
        raise SceneError(f"F[{bad[0]}] is not finite")
    made = law_of(material.law, (volume_floor,) if material.volume_floor > 0.0 else ())
    constants = lane_law(law).constants(material.mu, material.lam, *material.parameters.values())
    length = float(np.linalg.norm(fibre := checks.array(fibre, "evaluate_law: fibre", ((3,),))))
    if length == 0.0:
        raise SceneError("evaluate_law: fibre must not be zero")
    along = fibre / length if getattr(lane_law(law), "N_FIBRE", 0) else ()
    return made, F, np.concatenate([constants, along, volume_floor.table(floor, material.mu, material.lam)])


@contextmanager
def double_precision() -> Iterator[int]:
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
    law: str,
    F: np.ndarray,
    young: float | None = None,
    poisson: float | None = None,
    volume_floor: float = 0.0,
    fibre: tuple[float, float, float] = (1.0, 0.0, 0.0),
    **parameters: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Energy density psi (k,) [Pa], 0 at F = I, and first Piola-Kirchhoff stress P (k,3,3) [Pa], in float64.

    F: (k,3,3) deformation gradients; law, young [Pa], poisson, volume_floor, parameters: of a `Material`; fibre: the unit
    direction of a law with I4. Raises SceneError on a bad law, number or shape.
    """
    law_module, F, p = _checked(law, F, volume_floor, fibre, young=young, poisson=poisson, **parameters)
    with double_precision() as lanes:
        lane_F = _to_lanes(F, lanes)
        P, psi = np.empty_like(lane_F), np.empty((len(lane_F), lanes))
        _evaluate(law_module, lanes, lane_F, p, psi, P)
    return psi.reshape(-1)[: len(F)].copy(), _from_lanes(P, len(F)).copy()


def evaluate_differential(
    law: str,
    F: np.ndarray,
    dF: np.ndarray,
    young: float | None = None,
    poisson: float | None = None,
    projected: bool = False,
    volume_floor: float = 0.0,
    fibre: tuple[float, float, float] = (1.0, 0.0, 0.0),
    **parameters: float,
) -> np.ndarray:
    """Stress differential dP (k,3,3) [Pa] along dF (k,3,3), in float64; projected: use the positive semi-definite part."""
    law_module, F, p = _checked(law, F, volume_floor, fibre, young=young, poisson=poisson, **parameters)
    with double_precision() as lanes:
        lane_F, D = _to_lanes(F, lanes), _to_lanes(np.array(np.broadcast_to(dF, F.shape), dtype=np.float64), lanes)
        P = np.empty_like(lane_F)
        _differential(law_module, projected, lanes, lane_F, p, D, P)
    return _from_lanes(P, len(F)).copy()


def evaluate_blocks(law: str, F: np.ndarray, **numbers: float) -> np.ndarray:
    """Second derivative (k,9,9) [Pa] of psi by the law's `block`, in float64. numbers: as for `evaluate_law`."""
    law_module, F, p = _checked(law, F, 0.0, (1.0, 0.0, 0.0), **numbers)
    found = np.empty((len(F), 9, 9))
    with double_precision() as lanes:
        lane_F = _to_lanes(F, lanes)
        P = np.empty_like(lane_F)
        for a in range(3):
            for b in range(3):
                _block(law_module, a, b, lanes, lane_F, p, P)
                # entry (i, k): differential of P_ib along e_k (x) e_a
                found.reshape(-1, 3, 3, 3, 3)[:, :, b, :, a] = _from_lanes(P, len(F))
    return found


@kernel
def _block(law: ti.template(), a: ti.i32, b: ti.i32, lanes: ti.template(), F: ARRAY, p: ARRAY, P: ARRAY):
    for n in range(F.shape[0]):
        G = _load(F, n, lanes)
        c = _constants(law, p, lanes)
        ga = [0.0 * G[k] + ti.cast(a == k, ti.i32) for k in ti.static(range(3))]
        gb = [0.0 * G[k] + ti.cast(b == k, ti.i32) for k in ti.static(range(3))]
        _store(P, n, law.block(G, law.prepare(G, c), ga, gb), lanes)


def evaluate_dilatation(law: str, F: np.ndarray, **numbers: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """theta (k,) of mean dilatation, its derivative by F (k,3,3), and what a pressure of 1 Pa adds to the stress (k,3,3)."""
    law_module, F, p = _checked(law, F, 0.0, (1.0, 0.0, 0.0), **numbers)
    with double_precision() as lanes:
        lane_F = _to_lanes(F, lanes)
        theta, G, P = np.empty((len(lane_F), lanes)), np.empty_like(lane_F), np.empty_like(lane_F)
        _dilatation(law_module, lanes, lane_F, p, theta, G, P)
    return theta.reshape(-1)[: len(F)].copy(), _from_lanes(G, len(F)).copy(), _from_lanes(P, len(F)).copy()


@kernel
def _dilatation(law: ti.template(), lanes: ti.template(), F: ARRAY, p: ARRAY, theta: ARRAY, G: ARRAY, P: ARRAY):
    for n in range(F.shape[0]):
        A = _load(F, n, lanes)
        c = _constants(law, p, lanes)
        with_pressure, without = law.pk1(A, c + [1.0 + 0.0 * A[0]]), law.pk1(A, c)
        _store(P, n, [with_pressure[k] - without[k] for k in ti.static(range(9))], lanes)
        _store(G, n, law.dilatation_gradient(A), lanes)
        value = law.dilatation(A)
        for q in ti.static(range(lanes)):
            theta[n, q] = value[q]
