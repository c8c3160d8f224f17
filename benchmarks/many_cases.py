"""What `taisoft bench many` runs: cubes that slide to rest, and rollouts of a leg under random tensions."""

import numpy as np

import taisoft as ts

CUBE, GRAVITY = 0.1, 9.81  # edge [m], [m/s^2]
KNOTS, SECONDS = 6, 0.6  # of a rollout's tensions, and its length [s]
LEG = (0.04, 0.16, 0.04)  # [m]


def slide(friction: float, speed: float, cells: int = 6) -> dict:
    """A cube that starts at a speed [m/s] along the ground: how far it slides until it rests, beside v^2 / (2 mu g) [m]."""
    scene = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    rubber = ts.Material(young=1e6, poisson=0.3, density=1000.0, friction=friction, mass_damping=0.0, stiffness_damping=1e-3)
    cube = ts.box_mesh((cells, cells, cells), (CUBE, CUBE, CUBE))
    scene.add_body(cube, rubber, name="cube", position=(0.0, CUBE / 2, 0.0), velocity=(speed, 0.0, 0.0))
    scene.add_ground(friction=friction)
    ideal = speed**2 / (2.0 * friction * GRAVITY)
    path = []
    with ts.Simulator(scene, dt=1 / 800, integrator="implicit_euler") as sim:
        report = sim.run(
            1.2 * speed / (friction * GRAVITY), fps=100, on_frame=lambda sim, *_: path.append(sim.positions("cube").mean(axis=0))
        )
        distance = float(path[-1][0] - path[0][0])
        energy = sim.energies().kinetic
    return {"distance": distance, "over_ideal": distance / ideal, "kinetic": energy, "path": np.array(path), "run": report}


def rollout(seed: int, seconds: float = SECONDS) -> dict:
    """A soft leg, held at its top, whose foot taps the ground as two tendons pull at random: where the foot goes [m]."""
    scene, rng = ts.Scene(), np.random.default_rng(seed)
    soft = ts.Material(young=2e5, poisson=0.3, density=1000.0, friction=0.6, mass_damping=5.0)
    height = LEG[1] / 2
    body = scene.add_body(ts.box_mesh((2, 8, 2), LEG), soft, name="leg", position=(0.0, height + 3e-4, 0.0))
    body.fix(lambda X: X[:, 1] > height - 1e-6)
    times = np.linspace(0.0, seconds, KNOTS)
    for name, side in (("front", 1.0), ("back", -1.0)):
        tension = np.r_[0.0, rng.uniform(0.0, 4.0, KNOTS - 1)]
        line = [("leg", (side * LEG[0] / 2, y, 0.0)) for y in np.linspace(height, -height, 9)]
        scene.add_tendon(line, ts.KeyFrames(times, values=tension), name=name)
    scene.add_ground(friction=0.6)
    foot, path, load = body.rest_positions[:, 1] < -height + 1e-6, [], []

    def look(sim, *_) -> None:
        path.append(sim.positions("leg")[foot].mean(axis=0))
        load.append(sim.contact_force("leg", "ground")[1])

    with ts.Simulator(scene, dt=1 / 200, integrator="implicit_euler") as sim:
        report = sim.run(seconds, fps=100, on_frame=look)
    return {"reach": float(np.ptp([x[0] for x in path])), "load": max(load), "path": np.array(path), "run": report}
