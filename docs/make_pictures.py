"""Draws pictures and plots of the manual: `python docs/make_pictures.py [NAME ...]` writes docs/pictures/NAME.png."""

import json
import re
import sys
from pathlib import Path

import matplotlib.backends.backend_agg
import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "assets")]

from make_gallery import film  # noqa: E402
from train_hopper import STORED, program  # noqa: E402

import taisoft as ts  # noqa: E402
from taisoft.cli.scene_file import load_shipped  # noqa: E402
from taisoft.files import write_bytes  # noqa: E402
from taisoft.output.picture_files import SMALLEST, png_bytes  # noqa: E402

GROUND = ts.HalfSpace((0, 0, 0), (0, 1, 0))


def drop() -> np.ndarray:
    scene = ts.Scene()
    rubber = ts.Material(young=1e5, poisson=0.4, density=1000.0)
    scene.add_body(ts.ball_mesh(radius=0.1, cells=6), rubber, name="ball", position=(0, 0.5, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return strip(scene, 1 / 200, (0.0, 0.2, 0.3, 1.0), 50, (210, 300), ((0, 0.29, 0), 1.75, 32.0, 10.0))


def ring() -> np.ndarray:
    n, m, big, small = 48, 20, 0.12, 0.045
    u, v = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    x = [(big + small * np.cos(v)) * np.cos(u), small * np.sin(v), -(big + small * np.cos(v)) * np.sin(u)]
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    q = np.stack([(a % n) * m + b % m for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))], -1).reshape(-1, 4)
    surface = ts.SurfaceMesh(np.stack(x, -1).reshape(-1, 3), np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]))
    scene = ts.Scene()
    soft = ts.Material(young=5e4, poisson=0.4)
    mesh = ts.tetrahedralize(surface, edge_length=0.03)
    turned = mesh.vertices @ np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]).T
    scene.add_body(ts.TetMesh(turned, mesh.tets), soft, name="ring", position=(0, 0.3, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return strip(scene, 1 / 200, (0.0, 0.16, 0.3, 0.8), 50, (230, 230), ((0, 0.19, 0), 1.45, 32.0, 14.0), "body")


def identify() -> np.ndarray:
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    mesh = ts.box_mesh(cells=(11, 2, 2), size=(4.0, 1.0, 1.0))
    scene.add_body(mesh, ts.Material(young=3e6, mass_damping=2.0), name="beam").fix(lambda X: X[:, 0] < -1.99)
    return strip(scene, 1 / 60, (0.0, 8.0), 30, (420, 260), ((0, -0.35, 0), 9.5, 28.0, 14.0))


def strip(scene, dt, moments, fps, size, view, colour="stress") -> np.ndarray:
    with ts.Simulator(scene, dt=dt) as sim:
        picture, result = film(sim, moments, size, view, moments[-1], fps, colour=colour)
    if result.status != "ok":
        raise SystemExit(f"the run is {result.status}: {'; '.join(result.problems)}")
    return picture


def simulator(demo) -> ts.Simulator:
    """A simulator of a demo's scene."""
    return ts.Simulator(demo.build(), **{name: value for name, value in demo.solver.items() if name not in ("seconds", "fps")})


def drawn(figure: Figure) -> np.ndarray:
    """The pixels of a figure, uint8 (height, width, 3)."""
    canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def drop_force() -> np.ndarray:
    demo = load_shipped("demos", "drop_test")
    with simulator(demo) as sim:
        t, force, momentum = demo.record(sim)
        first, last, speed = demo.impact(t, force, momentum)
    shown, fine = slice(first - 20, last + 60), np.linspace(-0.1, 1.3, 2000) * demo.CONTACT
    figure = Figure((7.0, 3.2), dpi=100, layout="constrained")
    axes = figure.subplots()
    axes.plot(1e3 * (t - t[first])[shown], force[shown], color="tab:blue", label="sim.contact_force")
    axes.plot(1e3 * fine, demo.closed_form(fine, speed), "--", color="black", linewidth=1, label="closed form")
    axes.set(xlabel="time since the impact [ms]", ylabel="contact force [N]", xlim=1e3 * fine[[0, -1]])
    axes.legend()
    return drawn(figure)


def foot_forces() -> np.ndarray:
    demo = load_shipped("demos", "foot_on_ground")
    rows = []
    with simulator(demo) as sim:
        sim.run(demo.solver["seconds"], lambda sim, index, report: rows.append((sim.time, *sim.contact_force("sole"))), fps=None)
        contacts, dt = sim.contacts(), sim.dt
    t, friction, normal, _ = np.array(rows).T
    figure = Figure((8.0, 3.2), dpi=100, layout="constrained")
    over_time, ground = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    over_time.plot(t, normal, label="normal force")
    over_time.plot(t, friction, label="friction")
    over_time.plot(t, demo.FRICTION * normal, ":", color="gray", label="its limit")
    over_time.set(xlabel="time [s]", ylabel="force on the sole [N]")
    over_time.legend()
    pressed = (contacts.impulse * contacts.normal).sum(axis=1) / dt
    x, z = 1e3 * contacts.point[:, 0], 1e3 * contacts.point[:, 2]
    dots = ground.scatter(x, z, 120, pressed, cmap="viridis", edgecolor="gray")
    ground.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal", title="contacts at the end")
    figure.colorbar(dots, label="normal force [N]")
    return drawn(figure)


def hopper() -> np.ndarray:
    """What candidates flew while the hopper was trained, and the longest hop of the last mean."""
    record = json.loads(STORED.read_text())
    states = [env.sim.positions("block") for env in episode(record["mean"])]
    lowest = np.array([x[:, 1].min() for x in states])
    grounded = np.flatnonzero(np.append(lowest, 0.0) < 0.002)
    longest = int(np.diff(grounded).argmax())
    first, last = grounded[longest], grounded[longest + 1]
    middle = states[first][:, 0].mean()
    corners = [(middle - 0.08, 0.0, -0.05), (middle + 0.14, 0.16, 0.05)]
    moments = np.linspace(first - 2, last + 2, 6).round().astype(int)
    pictures = [env.render() for k, env in enumerate(episode(record["mean"], corners)) if k in moments]
    figure = Figure((6.4, 4.0), dpi=96, layout="constrained")
    axes, below = figure.subplots(2, 1, height_ratios=(1.0, 0.9))
    for values, label in zip(np.transpose(record["curve"]), ("mean", "best")):
        axes.plot(values, label=label)
    title = f"{len(record['curve'])} generations of 32 candidates, in {record['minutes']:.0f} minutes"
    axes.set(xlabel="generation", ylabel="distance in the air [m]", title=title)
    axes.legend()
    below.imshow(np.concatenate(pictures, axis=1))
    below.set(title=f"a hop, in pictures {10 * (moments[1] - moments[0])} ms apart", xticks=[], yticks=[])
    return drawn(figure)


def episode(mean: list[float], corners=None, seed: int = 5):
    """The environment after each step of an episode of the trained hopper, before it falls."""
    names = program()
    with names["make"](render_mode="rgb_array", size=(200, 216), view=corners) as env:
        sensed, _ = env.reset(seed=seed)
        for _ in range(200):
            sensed, _, fell, *_ = env.step(names["policy"](np.array([mean]), sensed[None])[0])
            if fell:
                break
            yield env


def pressed_ball() -> np.ndarray:
    """Pressure and friction on the ball of the chapter on contact mechanics, whose first block builds it."""
    page = (Path(__file__).parent / "tutorials" / "contact_mechanics.md").read_text(encoding="utf-8")
    names: dict = {}
    exec(re.search(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)[1], names)
    figure = Figure((8.0, 3.2), dpi=100, layout="constrained")
    pressure, friction = figure.subplots(1, 2, sharex=True)
    for mu, colour in ((0.0, "tab:blue"), (0.5, "tab:orange")):
        found = ts.solve_static(names["build"](16, friction=mu), steps=4 if mu else 1)
        p = found.contact_pressure("ball")
        on = (p.area > 0.0) & (p.pressure > 0.0)  # corners; middles have means
        x = found.positions("ball")[p.index[on]][:, [0, 2]]
        r, value = np.linalg.norm(x, axis=1), 1e-3 * p.pressure[on]
        pressure.plot(r, value, "o", color=colour, markersize=4, label=f"friction {mu:g}")
        if mu == 0.0:
            force = 4 * found.contact_force("ball", "plane")[1]
            reach = np.cbrt(0.75 * force * (1 - 0.3**2) / 1e6)
            fine = np.linspace(0.0, reach, 200)
            hertz = 1.5e-3 * force / (np.pi * reach**2) * np.sqrt(1 - (fine / reach) ** 2)
            pressure.plot(fine, hertz, color="black", linewidth=1, label="Hertz, friction 0")
    outward = 1e-3 * (p.traction[on][:, [0, 2]] * x).sum(axis=1) / np.maximum(r, 1e-12)
    for state, colour in (("stick", "tab:green"), ("slip", "tab:red")):
        own = p.state[on] == state
        friction.plot(r[own], outward[own], "o", color=colour, markersize=4, label=state)
    order = np.argsort(r)
    friction.plot(r[order], mu * value[order], color="gray", linewidth=1, label="friction times pressure")
    pressure.set(xlabel="radius [m]", ylabel="pressure [kPa]", xlim=(-0.005, 0.18))
    friction.set(
        xlabel="radius [m]", ylabel="radial traction on the ball [kPa]", ylim=(-2.5, 80.0), title="friction 0.5, four load steps"
    )
    pressure.legend()
    friction.legend(loc="upper right")
    return drawn(figure)


PICTURES = {
    "drop": drop,
    "ring": ring,
    "identify": identify,
    "drop_force": drop_force,
    "foot_forces": foot_forces,
    "hopper": hopper,
    "pressed_ball": pressed_ball,
}


def main(names: list[str]) -> None:
    for name in names or PICTURES:
        data = png_bytes(PICTURES[name](), SMALLEST)
        write_bytes(Path(__file__).parent / "pictures" / f"{name}.png", data)
        print(f"{name}: {len(data):,} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
