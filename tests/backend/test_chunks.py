"""Loops over chunks, and the choice between one thread and several:

* every integrator gives the same bits on one thread and on several, with and without contacts, damping and mean dilatation; the
  chunks themselves change only rounding;
* reactions of explicit steps are those of one thread, whatever the number of sub-steps in a batch;
* the chunks of a list are disjoint, in order and cover it; sums and least values by chunks are those of the list;
* the gain by threads is measured once, kept unless other programs may have hidden it, and measured again where the file is
  unusable.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend import parallel
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel, open_runtime, threads
from taisoft.fem.chunks import FOLDED, chunk_entry, chunk_size, fold, part_first, total
from taisoft.fem.state import N_COLUMNS, OTHER_SUM, SUM
from tests.dynamics.scenes import SNH, SVK, built, driven_scene, mixed_scene, use_threads


def pile() -> ts.Scene:
    scene = ts.Scene()
    rubber = ts.Material(young=3e4, stiffness_damping=1e-3)
    mesh = ts.box_mesh(cells=(3, 3, 3), size=(0.3, 0.3, 0.3))
    for k in range(2):
        scene.add_body(mesh, rubber, position=(0.07 * k, 0.16 + 0.31 * k, 0.02 * k), velocity=(0, -1, 0), name=f"cube {k}")
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    return scene


def soft_in_shape() -> ts.Scene:
    scene = ts.Scene()
    mesh = ts.box_mesh(cells=(4, 2, 2), size=(4, 1, 1))
    body = scene.add_body(mesh, ts.Material(young=1e5, poisson=0.49), dilatation="mean", name="beam")
    body.fix(lambda X: X[:, 0] < -1.99)
    return scene


SCENES = {
    "driven": lambda: driven_scene(mass_damping=3.0),
    "driven of order 2": lambda: driven_scene(mass_damping=3.0, order=2),
    "mixed": lambda: mixed_scene((SNH, SVK, SNH, SVK)),
    "pile": pile,
    "mean": soft_in_shape,
}
CASES = (
    ("driven", "velocity_verlet", "f64"),
    ("pile", "implicit_euler", "f64"),
    *(
        pytest.param(*case, marks=pytest.mark.long)
        for case in (
            ("driven of order 2", "implicit_midpoint", "f64"),
            ("mixed", "bdf2", "f64"),
            ("mixed", "linearly_implicit_euler", "f32"),
            ("mean", "implicit_euler", "f64"),
            ("pile", "symplectic_euler", "f64"),
        )
    ),
)
STEPS = 6


def run(scene: ts.Scene, integrator: str, precision: str) -> tuple:
    """State, energies, counts of each step; whether loops are divided into chunks."""
    explicit = integrator in ("symplectic_euler", "velocity_verlet")
    with ts.Simulator(scene, dt=1e-4 if explicit else 5e-3, integrator=integrator, precision=precision) as sim:
        counts, divided = [], sim.field_bytes["partial"] > 8 * N_COLUMNS
        while sim.step_count < STEPS:
            report = sim.advance(STEPS - sim.step_count) if explicit else sim.step()
            counts.append((report.newton_iterations, report.linear_iterations, report.min_volume_ratio))
        return sim.positions(), sim.velocities(), sim.energies(), counts, divided


@pytest.mark.parametrize(("name", "integrator", "precision"), CASES)
def test_any_number_of_threads_gives_the_same_bits(name, integrator, precision, monkeypatch):
    whole = run(SCENES[name](), integrator, precision)
    use_threads(monkeypatch, several=False)
    one = run(SCENES[name](), integrator, precision)
    asked = use_threads(monkeypatch)
    several = run(SCENES[name](), integrator, precision)
    assert all(np.array_equal(a, b) for a, b in zip(one[:2], several[:2]))
    assert one[2:4] == several[2:4]
    assert [made[4] for made in (whole, one, several)] == [False, True, True] and asked == [True]
    tolerance = 1e-5 if precision == "f32" else 1e-6  # [m]: those of Newton's method and of f32 strains
    assert np.abs(one[0] - whole[0]).max() < tolerance


@pytest.mark.parametrize(
    "integrator, damping", [("velocity_verlet", 0.01), pytest.param("symplectic_euler", 0.0, marks=pytest.mark.long)]
)
def test_reactions_of_sub_steps_on_all_cores(integrator, damping, monkeypatch):
    """Only the last sub-step of a batch computes them, and batches may have one."""
    scene = ts.Scene()
    rubber = ts.Material(young=1e5, mass_damping=100.0 * damping, stiffness_damping=damping)
    scene.add_body(ts.box_mesh((3, 1, 1), (0.3, 0.1, 0.1)), rubber).fix(lambda X: X[:, 0] < -0.14)
    found = []
    for several in (None, False, True):
        if several is not None:
            use_threads(monkeypatch, several)
        with ts.Simulator(scene, dt=1e-4, integrator=integrator, precision="f64") as sim:
            for n in (1, 1, 7, 2):
                sim.advance(n)
                found.append((sim.reactions(), sim.positions(), sim.velocities()))
            assert sim.step_count == 11 and np.abs(sim.reactions()).max() > 1e-2  # [N]
    for whole, one, many in zip(found[:4], found[4:8], found[8:]):
        assert all(np.array_equal(a, b) for a, b in zip(one, many))
        assert all(np.abs(a - b).max() < 1e-9 * np.abs(a).max() for a, b in zip(whole, one))


@kernel
def write_parts(out: ti.types.ndarray(), n: ti.i32, chunks: ti.template()):
    """First entry of each chunk, and the number of entries."""
    for c in range(chunks + 1):
        out[c] = part_first(c, n, chunks)


@pytest.mark.parametrize("n", [0, 6, 8, 1000])
def test_chunks_cover_a_list_in_order(n):
    runtime, first = open_runtime("cpu", "f64"), np.zeros(8, dtype=np.int32)
    try:
        write_parts(first, n, 7)
    finally:
        runtime.close()
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


@pytest.mark.parametrize(("on_cpu", "chunks"), [(True, 32), (False, 8), (False, 4 * FOLDED)])
@pytest.mark.parametrize("n", [0, 9999])
def test_sums_over_chunks(on_cpu, chunks, n):
    """Also as on CUDA, where a chunk takes every so-many-th entry and the partial sums are folded."""
    with built(mixed_scene(), "f64") as rig:
        arena = FieldArena()
        partial = arena.field("partial", ti.f64, (chunks, N_COLUMNS))
        model = replace(rig.model, on_cpu=on_cpu, chunks=chunks, state=replace(rig.model.state, partial=partial))
        values, out = np.random.default_rng(n).integers(-99, 99, n).astype(np.float64), np.zeros(n + 2)
        sum_entries(model, values, out)
        assert out[0] == values.sum() and out[1] == values.min(initial=1e9) and (out[2:] == 1.0).all()
        arena.release()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The file of the measurements, in a folder of its own."""
    monkeypatch.setattr(parallel, "cache_folder", lambda: str(tmp_path))
    parallel.gain.cache_clear()
    runtime = open_runtime("cpu", "f64")
    yield tmp_path / parallel.FILE
    runtime.close()
    parallel.gain.cache_clear()


def test_the_gain_is_measured_once_and_kept(cache, monkeypatch):
    monkeypatch.setattr(parallel, "measure", lambda: parallel.Gain(1e-5, 1.9))
    measured = parallel.gain()
    assert 0.0 < measured.wake < 0.1 and 0.0 < measured.speedup <= threads()
    stored = json.loads(cache.read_text())
    assert list(stored) == [f"{parallel.processor()}, {threads()} threads"]
    cache.write_text(json.dumps({name: one | {"wake": 12.5} for name, one in stored.items()}))
    assert parallel.gain() == measured
    parallel.gain.cache_clear()
    assert parallel.gain().wake == 12.5


@pytest.mark.parametrize("content", ["", "{", "[]", '{"a": 1}', '{"a": {"wake": "b", "speedup": 1}}', "stored"])
def test_an_unusable_file_is_replaced(cache, content, monkeypatch):
    monkeypatch.setattr(parallel, "measure", lambda: parallel.Gain(1e-5, 1.9))
    if content == "stored":  # impossible numbers
        content = json.dumps({f"{parallel.processor()}, {threads()} threads": {"wake": 0.0, "speedup": 0.0}})
    cache.write_text(content)
    measured = parallel.gain()
    assert list(json.loads(cache.read_text()).values()) == [{"wake": measured.wake, "speedup": measured.speedup}]


def test_a_gain_that_other_programs_may_hide_is_not_kept(cache, monkeypatch):
    monkeypatch.setattr(parallel, "measure", lambda: parallel.Gain(1e-4, 1.1))
    assert parallel.gain().speedup == 1.1 and not cache.exists()


def test_short_loops_run_on_one_thread():
    two = parallel.Gain(wake=5e-5, speedup=2.0)
    assert 1e-4 < two.shortest_loop < 2e-4
    assert parallel.Gain(wake=5e-5, speedup=4.0).shortest_loop < two.shortest_loop
    for speedup in (0.5, 1.0):  # more cores are visible than may be used
        assert parallel.Gain(wake=5e-5, speedup=speedup).shortest_loop == float("inf")
