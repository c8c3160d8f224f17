"""Kernels that a team or many threads run on a GPU give what one thread gives, whatever the order of the entries.

Each launch in a simulation is repeated with the same data and loops as on a GPU, with teams in two orders of their threads.
"""

import dataclasses

import numpy as np

import taisoft as ts
from taisoft.backend.arrays import Array
from taisoft.backend.paths import Order
from taisoft.backend.team import Team
from taisoft.collision import detector
from taisoft.dynamics import contact_measures, dynamics, friction, impact, misplaced, rebounds, renewal

ORDERS = (Order(7), Order(64, True))
SCRATCH = ("pair_slot", "is_kept", "source", "active_of_chunk", "sums")  # whose contents depend on the order
KERNELS = (
    *((renewal, name) for name in ("judge", "adopt", "largest_motion")),
    *((contact_measures, name) for name in ("measure_closing", "drop_uncertain")),
    *((detector, name) for name in ("update_surface", "find_crossings")),
    *((impact, name) for name in ("begin_impact", "measure_impact", "rebound_work")),
    *((rebounds, "find_rebounds"), (misplaced, "add_step"), (friction, "extrapolate_multipliers"), (dynamics, "measure")),
)


def arrays(value, path: str = "", seen: dict | None = None) -> dict[str, Array]:
    """The arrays of a record by path."""
    seen = {} if seen is None else seen
    if isinstance(value, Array):
        seen[path] = value
    elif isinstance(value, tuple):
        for k, part in enumerate(value):
            arrays(part, f"{path}.{k}", seen)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in SCRATCH:
                arrays(getattr(value, field.name), f"{path}.{field.name}", seen)
    return seen


def threaded(value, order: Order):
    """A record as on the GPU path."""
    if isinstance(value, tuple) and not dataclasses.is_dataclass(value):
        return tuple(threaded(part, order) for part in value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    new = {f.name: threaded(getattr(value, f.name), order) for f in dataclasses.fields(value)}
    new |= {name: False for name in ("serial", "serial_cheap", "on_cpu") if name in new}
    new |= {name: 1 for name in ("spread", "cheap_spread") if name in new}
    if isinstance(value, Team):
        return Team(*order)
    return dataclasses.replace(value, **new) if new else value


class Repeated:
    """Stands for a kernel, and repeats each launch with other orders; `launches` counts them."""

    def __init__(self, kernel):
        self.kernel, self.launches = kernel, 0

    def __call__(self, *arguments):
        self.launches += 1
        known = {name: array for k, one in enumerate(arguments) for name, array in arrays(one, str(k)).items()}
        before = {name: array.to_numpy() for name, array in known.items()}
        result = self.kernel(*arguments)
        after = {name: array.to_numpy() for name, array in known.items()}
        for order in ORDERS:
            for name, array in known.items():
                array.from_numpy(before[name])
            again = self.kernel(*(threaded(one, order) for one in arguments))
            assert again == result, (self.kernel, order)
            for name, array in known.items():
                assert np.array_equal(array.to_numpy(), after[name], equal_nan=True), (self.kernel, order, name)
        for name, array in known.items():
            array.from_numpy(after[name])
        return result


def stack() -> ts.Scene:
    """Two cubes that fall onto each other and onto a slope and a ball, with friction and restitution."""
    scene = ts.Scene()
    rubber = ts.Material(young=1e5, density=1000.0, friction=0.4, restitution=0.5)
    for k, name in enumerate(("low", "high")):
        mesh = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
        scene.add_body(mesh, rubber, name=name, position=(0.01 * k, 0.058 + 0.102 * k, 0), velocity=(1.0, -2.0 * k, 0.2))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0.1, 1, 0)), name="slope", friction=0.4)
    scene.add_obstacle(ts.Sphere((0.16, 0.05, 0), 0.05), name="ball", friction=0.2)
    return scene


def test_launches_are_the_same_in_every_order(monkeypatch):
    repeated = {}
    for module, name in KERNELS:
        repeated[name] = Repeated(getattr(module, name))
        monkeypatch.setattr(module, name, repeated[name])
    with ts.Simulator(stack(), dt=4e-3, integrator="implicit_euler", precision="f64") as sim:
        for _ in range(16):
            sim.step()
            sim.energies()
    assert not [name for name, one in repeated.items() if one.launches == 0]
