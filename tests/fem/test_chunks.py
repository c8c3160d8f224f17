"""Loops over chunks, on one thread and on several:

* steps, energies and reactions are the same bits on one thread and on several, whatever the number of sub-steps in a batch, with
  and without contacts, damping and mean dilatation; the chunks themselves change only rounding;
* the chunks of a list are disjoint, in order and cover it; sums and least values by chunks are those of the list.
"""

from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import FOLDED, chunk_entry, chunk_size, fold, part_first, total
from taisoft.fem.state import N_COLUMNS, OTHER_SUM, SUM
from tests.backend.lanes import opened
from tests.dynamics.scenes import SNH, SVK, built, mixed_scene, use_threads


def clamped(dilatation: str | None = None) -> ts.Scene:
    """A damped beam."""
    scene = ts.Scene()
    soft = ts.Material(young=1e5, poisson=0.45, mass_damping=1.0, stiffness_damping=1e-3)
    shape = {} if dilatation is None else {"dilatation": dilatation}
    scene.add_body(ts.box_mesh((4, 2, 2), (0.4, 0.1, 0.1)), soft, **shape).fix(lambda X: X[:, 0] < -0.19)
    return scene


def pile() -> ts.Scene:
    scene = ts.Scene()
    rubber = ts.Material(young=3e4, stiffness_damping=1e-3)
    mesh = ts.box_mesh(cells=(3, 3, 3), size=(0.3, 0.3, 0.3))
    for k in range(2):
        scene.add_body(mesh, rubber, position=(0.07 * k, 0.16 + 0.31 * k, 0.02 * k), velocity=(0, -1, 0), name=f"cube {k}")
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    return scene


SCENES = {"clamped": clamped, "mean": lambda: clamped("mean"), "mixed": lambda: mixed_scene((SNH, SVK, SNH, SVK)), "pile": pile}
LONG = (
    ("clamped", "velocity_verlet", "f64"),
    ("mean", "implicit_euler", "f64"),
    ("mixed", "linearly_implicit_euler", "f32"),
    ("pile", "implicit_euler", "f64"),
)
CASES = [("clamped", "bdf2", "f64"), *(pytest.param(*case, marks=pytest.mark.long) for case in LONG)]


def run(scene: ts.Scene, integrator: str, precision: str) -> tuple:
    """Vectors and numbers after batches of steps, and whether loops are divided into chunks."""
    explicit, vectors, numbers = integrator == "velocity_verlet", [], []
    with ts.Simulator(scene, dt=1e-4 if explicit else 5e-3, integrator=integrator, precision=precision) as sim:
        for n in (1, 1, 3, 2):
            report = sim.advance(n)
            numbers.append((report.newton_iterations, report.linear_iterations, report.min_volume_ratio, sim.energies()))
            vectors += [sim.positions(), sim.velocities(), sim.reactions()]
        return vectors, numbers, sim.field_bytes["partial"] > 8 * N_COLUMNS


@pytest.mark.parametrize(("name", "integrator", "precision"), CASES)
def test_any_number_of_threads_gives_the_same_bits(name, integrator, precision, monkeypatch):
    whole = run(SCENES[name](), integrator, precision) if integrator == "velocity_verlet" else None
    use_threads(monkeypatch, several=False)
    one = run(SCENES[name](), integrator, precision)
    asked = use_threads(monkeypatch)
    several = run(SCENES[name](), integrator, precision)
    assert all(np.array_equal(a, b) for a, b in zip(one[0], several[0], strict=True)) and asked == [True]
    assert one[1:] == several[1:] and one[2]
    if whole is not None:
        assert np.abs(one[0][-1]).max() > 1e-2 and not whole[2]  # [N]
        assert all(np.abs(a - b).max() < 1e-9 * np.abs(a).max() for a, b in zip(whole[0], one[0], strict=True))


@kernel
def write_parts(out: ti.types.ndarray(), n: ti.i32, chunks: ti.template()):
    """First entry of each chunk, and the number of entries."""
    for c in range(chunks + 1):
        out[c] = part_first(c, n, chunks)


def test_chunks_cover_a_list_in_order():
    with opened("f64"):
        for n in (0, 6, 8, 1000):
            first = np.zeros(8, dtype=np.int32)
            write_parts(first, n, 7)
            sizes = np.diff(first)
            assert first[0] == 0 and first[-1] == n and sizes.min() >= 0 and sizes.max() - sizes.min() <= 1


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
        out[0], out[1] = total(m, SUM), m.state.partial[0, OTHER_SUM]
        for c in range(1, m.sums):
            out[1] = ti.min(out[1], m.state.partial[c, OTHER_SUM])


def test_sums_over_chunks():
    """Also as on CUDA, where a chunk takes every so-many-th entry and the partial sums are folded."""
    with built(mixed_scene(), "f64") as rig:
        for on_cpu, chunks in ((True, 32), (False, 8), (False, 4 * FOLDED)):
            arena = FieldArena()
            partial = arena.field("partial", ti.f64, (chunks, N_COLUMNS))
            model = replace(rig.model, on_cpu=on_cpu, chunks=chunks, state=replace(rig.model.state, partial=partial))
            for n in (0, 9999):
                values, out = np.random.default_rng(n).integers(-99, 99, n).astype(np.float64), np.zeros(n + 2)
                sum_entries(model, values, out)
                assert out[0] == values.sum() and out[1] == values.min(initial=1e9) and (out[2:] == 1.0).all()
            arena.release()
