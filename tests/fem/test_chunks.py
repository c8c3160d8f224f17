"""Loops over chunks: steps, energies and reactions are the same bits on one thread and on several; chunks cover a list; sums and
least values by chunks are those of the list.
"""

from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import FOLDED, chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.state import N_COLUMNS, OTHER_SUM, SUM
from tests.dynamics.scenes import built, mixed_scene, use_threads


def run_beam(touches: bool) -> tuple[list, list]:
    """Vectors and numbers of steps of a damped beam, alone or on the ground, whose loops are divided into chunks."""
    scene, vectors, numbers = ts.Scene(), [], []
    soft = ts.Material(young=1e5, poisson=0.45, mass_damping=1.0)
    scene.add_body(ts.box_mesh((4, 2, 2), (0.4, 0.1, 0.1)), soft).fix(lambda X: X[:, 0] < -0.19)
    if touches:
        scene.add_obstacle(ts.HalfSpace((0, -0.0501, 0), (0.1, 1, 0)))
    with ts.Simulator(scene, dt=5e-3, integrator="implicit_euler", precision="f64") as sim:
        for _ in range(4):
            report = sim.step()
            numbers.append((report.newton_iterations, report.linear_iterations, report.min_volume_ratio, sim.energies()))
            vectors += [sim.positions(), sim.velocities(), sim.reactions()]
        assert sim.field_bytes["partial"] > 8 * N_COLUMNS
    return vectors, numbers


@pytest.mark.parametrize("touches", [False, pytest.param(True, marks=pytest.mark.long)])
def test_any_number_of_threads_gives_the_same_bits(monkeypatch, touches):
    use_threads(monkeypatch, several=False)
    one = run_beam(touches)
    asked = use_threads(monkeypatch)
    several = run_beam(touches)
    assert all(np.array_equal(a, b) for a, b in zip(one[0], several[0], strict=True)) and asked == [True]
    assert one[1] == several[1]


@kernel
def sum_entries(m: ti.template(), values: ti.types.ndarray(), out: ti.types.ndarray()):
    """Sum and least of the values by chunks, and how often each was taken."""
    for c in range(m.chunks):
        s, least = ti.cast(0.0, ti.f64), ti.cast(1e9, ti.f64)
        for k in range(chunk_size(m, c, values.shape[0])):
            i = chunk_entry(m, c, k, values.shape[0])
            s += values[i]
            least = ti.min(least, values[i])
            out[2 + i] += 1.0
        m.state.partial[c, SUM], m.state.partial[c, OTHER_SUM] = s, least
    fold(m, SUM, OTHER_SUM, (OTHER_SUM,))
    ti.loop_config(serialize=True)
    for _ in range(1):
        out[0], out[1] = total_by_team(m, 0, SUM), m.state.partial[0, OTHER_SUM]
        for c in range(1, m.sums):
            out[1] = ti.min(out[1], m.state.partial[c, OTHER_SUM])


def test_sums_over_chunks():
    """Also as on CUDA, where a chunk takes every so-many-th entry and the partial sums are folded."""
    with built(mixed_scene(), "f64") as rig:
        for on_cpu, chunks in ((True, 32), (False, 8), (False, 4 * FOLDED)):
            arena = FieldArena()
            partial = arena.field("partial", ti.f64, (chunks, N_COLUMNS))
            model = replace(rig.model, on_cpu=on_cpu, chunks=chunks, state=replace(rig.model.state, partial=partial))
            for n in (0, 6, 9999):
                values, out = np.random.default_rng(n).integers(-99, 99, n).astype(np.float64), np.zeros(n + 2)
                sum_entries(model, values, out)
                assert out[0] == values.sum() and out[1] == values.min(initial=1e9) and (out[2:] == 1.0).all()
            arena.release()
