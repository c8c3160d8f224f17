"""Batches of explicit sub-steps with contacts.

* On the GPU path they run on the device alone, with at most eight launches a sub-step and three accesses a batch, while contacts
  stick, slide and appear;
* they give the bits of single sub-steps, in any order in which a team's threads take the entries of a phase;
* so does every event in the middle of one: a solve that takes more launches, a velocity that is no longer finite, a path that is
  not free, and a search or a contact problem without room;
* Ctrl-C in the middle of one leaves the state after the last sub-step that was accepted.
"""

import pytest

import taisoft as ts
from taisoft.backend.arrays import Array
from taisoft.backend.counters import FILLS, counting, device_only
from taisoft.backend.paths import AS_WRITTEN, Order, gpu_path
from taisoft.dynamics import explicit_batch
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.explicit_batch import DONE, FAULT, MOST, NOT_FOUND, NOT_FREE, NOT_SOLVED, NOTHING, Batch
from tests.dynamics.scenes import dynamics

DT, N = 2e-4, 16
INTEGRATORS = "symplectic_euler", "velocity_verlet"


def scene(cells=(2, 2, 2), gravity: float = -9.81, velocity=(0.3, -0.3, 0), **settings) -> ts.Scene:
    """A tilted cube that lands on a half-space with friction, beside a ball that it slides to."""
    made = ts.Scene(gravity=(0, gravity, 0))
    made.collision = ts.CollisionSettings(**settings)
    rubber = ts.Material(law="stable_neo_hookean", young=1e5, poisson=0.3, density=1000.0)
    cube = ts.box_mesh(cells, (0.1,) * 3, pattern="six")
    tilted = ts.TetMesh(cube.vertices + 0.1 * cube.vertices[:, [1, 0, 2]] * (-1.0, 1.0, 0.0), cube.tets)
    made.add_body(tilted, rubber, name="cube", position=(0, 0.056, 0), velocity=velocity)
    made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    made.add_obstacle(ts.Sphere((0.09, 0.02, 0.0), 0.03), name="ball", friction=0.2)
    return made


def take(sim: Dynamics, n: int) -> list:
    """Take n sub-steps. Return what is reported, with the message of an error that ends them."""
    reports = []
    try:
        while n > 0:
            report = sim.advance(n)
            n -= report.steps
            numbers = report.contact_iterations, report.contact_residual, report.max_penetration, report.min_volume_ratio
            reports.append((*numbers, report.converged, report.n_contacts, report.problems))
    except ts.SimulationError as error:
        reports.append(str(error))
    return reports


def state(sim: Dynamics) -> list[bytes]:
    contacts = sim.contact.contacts()
    arrays = *sim.state.state(), contacts.impulse, contacts.gap, contacts.slip, contacts.state.astype(str)
    return [array.tobytes() for array in arrays] + [contacts.found, sim.state.step_count]


def run(made: ts.Scene, n: int, integrator: str = "velocity_verlet", floor: float | None = None) -> tuple:
    """What is reported of n sub-steps, and the state and contacts after them. floor [m]: to be kept by paths."""
    with dynamics(made, dt=DT, integrator=integrator, precision="f64") as sim:
        if floor is not None:
            sim.contact.detection.paths.floor = floor
        return take(sim, n), state(sim)


@pytest.fixture
def singly(monkeypatch):
    """A function that calls another where no batches are taken."""

    def call(function, *arguments):
        with monkeypatch.context() as patch:
            patch.setattr(Batch, "suits", lambda self: False)
            return function(*arguments)

    return call


@pytest.fixture
def events(monkeypatch) -> set[tuple[bool, int]]:
    """Of each batch that has run: whether it had accepted sub-steps before its end, and the event that ended it."""
    seen, plain = set(), Batch.run

    def watched(self, *arguments):
        plain(self, *arguments)
        seen.add((bool(self.tally[DONE] > 0), self.event))

    monkeypatch.setattr(Batch, "run", watched)
    return seen


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_counts_of_a_batch(integrator, monkeypatch):
    plain, batches, states = Batch.launch, 0, set()

    def alone(*arguments):
        with device_only():
            plain(*arguments)

    monkeypatch.setattr(Batch, "launch", alone)
    with gpu_path(), dynamics(scene(), dt=DT, integrator=integrator, precision="f64") as sim:
        take(sim, 5 * N)  # compiles
        batch, good = sim.stepper.batch, sim.stepper.good
        for _ in range(8):
            n_before = sim.contact.n_contacts
            with counting() as counts:
                batch.run(N, sim.state.time, DT, good, 1000)
            accesses = counts.accesses.total() - counts.accesses[FILLS] + counts.returned.total() + counts.host_arrays.total()
            assert batch.event == NOTHING and batch.tally[DONE] == N
            assert counts.launches.total() <= 8 * N + 1 and accesses <= 3
            batches += sim.contact.n_contacts > n_before
            states |= set(sim.contact.contacts().state)
    assert batches and states == {"open", "stick", "slip"}


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_batches_are_single_substeps(integrator, singly, events):
    n = 3 * MOST + 5
    assert run(scene(), n, integrator) == singly(run, scene(), n, integrator)
    found = []
    for order in (AS_WRITTEN, Order(64, True)):
        with gpu_path(order):
            found.append(run(scene(), n, integrator))
    assert found[0] == found[1]
    with gpu_path():
        assert found[0] == singly(run, scene(), n, integrator)
    assert events == {(True, NOTHING)}


@pytest.mark.filterwarnings("ignore:body 'cube'")  # about such a weight
@pytest.mark.parametrize("integrator, on_gpu_path", zip(INTEGRATORS, (False, True)))
@pytest.mark.parametrize("event", [NOT_SOLVED, FAULT, NOT_FREE, NOT_FOUND])
def test_events_end_as_single_substeps(event, integrator, on_gpu_path, singly, events, monkeypatch):
    n, floor, made = 6 * MOST, None, scene
    if event == NOT_SOLVED:  # most sub-steps need five sweeps, some more
        n = 9 * MOST
        monkeypatch.setattr(explicit_batch, "sweeps_per_launch", lambda n: 5)
    elif event == FAULT:  # after five sub-steps f32 does not hold the velocity
        made = lambda: scene(gravity=3e38, velocity=(0, 3.4e38, 0))  # noqa: E731
    elif event == NOT_FREE:
        floor, made = 2e-4, lambda: scene(velocity=(0.3, -3.0, 0))  # it lands nearer
    elif not on_gpu_path:  # where the buffer has many parts, it is large
        made = lambda: scene(cells=(8, 1, 8), initial_capacity=64)  # noqa: E731
    else:
        n = 2 * MOST
        monkeypatch.setattr(explicit_batch, "NODES", 10**9)
    with gpu_path() if on_gpu_path else pytest.MonkeyPatch.context():
        found = run(made(), n, integrator, floor)
        assert found == singly(run, made(), n, integrator, floor)
    is_first = event == FAULT and integrator == "velocity_verlet"  # whose forces are computed after the first drift
    is_first |= event == NOT_FOUND and on_gpu_path
    assert (not is_first, event) in events
    assert isinstance(found[0][-1], str) == (event == FAULT)


def test_a_batch_begins_with_room_for_its_contacts(singly):
    """A cube falls on many half-spaces, whose contacts are more than the problem holds at first."""
    made = scene(cells=(3, 3, 3))
    for k in range(120):
        made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name=f"ground {k}")
    found = run(made, 2 * MOST)
    assert found == singly(run, made, 2 * MOST) and found[0][-1][-2] > 1240  # contacts


@pytest.mark.parametrize("place", ["launch", "begin", "read"])
def test_an_interrupt_leaves_the_last_accepted_substep(place, monkeypatch):
    n_before, count = 2 * MOST + 5, []

    def interrupted(plain, at: int):
        def call(*arguments):
            count.append(1)
            if len(count) == at:
                raise KeyboardInterrupt
            return plain(*arguments)

        return call

    with dynamics(scene(), dt=DT, integrator="velocity_verlet", precision="f64") as sim:
        take(sim, 10)
        if place == "launch":
            monkeypatch.setattr(Batch, "launch", interrupted(Batch.launch, n_before + 1))
        elif place == "begin":
            monkeypatch.setattr(explicit_batch, "begin_tally", interrupted(explicit_batch.begin_tally, 3))
        else:
            monkeypatch.setattr(Array, "to_numpy", interrupted(Array.to_numpy, 2))
        with pytest.raises(KeyboardInterrupt):
            sim.advance(3 * MOST)
        monkeypatch.undo()
        at, positions = sim.state.step_count, sim.state.state()[0]
        assert at == 10 + {"launch": n_before, "begin": 2 * MOST, "read": 2 * MOST}[place]
        take(sim, 10)
    with dynamics(scene(), dt=DT, integrator="velocity_verlet", precision="f64") as sim:
        take(sim, at)
        assert (sim.state.state()[0] == positions).all()
