"""What tests of pictures and windows share: masks of pictures, scenes with everything that is drawn, and child processes."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.nested import from_json, to_json
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.sampling import Sampler
from taisoft.view.window.ggui import vulkan_missing
from tests.dynamics.scenes import rubber
from tests.view.fake_simulator import beam_scene

SIZE = (320, 180)
needs_vulkan = pytest.mark.skipif(bool(vulkan_missing()), reason="no Vulkan driver: Debian package mesa-vulkan-drivers")


def program(code: str) -> tuple[str, ...]:
    """The arguments of Python for a process that stands in for a window or for the process of pictures."""
    return "-c", code


def body_mask(image):
    """Coloured pixels: the background is grey."""
    rgb = image.astype(int)
    return rgb.max(axis=2) - rgb.min(axis=2) > 20


def sampled(sim, layers=(), *kinds):
    """The state of a simulation, which travelled as plain data."""
    sampler = Sampler(sim.scene)
    state = sampler.state(sim, layers, kinds)
    arrays = {"displacement": state.displacement, "values": state.values}
    return DrawnState(travelled(sampler.drawn), **from_json(to_json(state.plain())), **arrays)


def travelled(drawn: DrawnScene) -> DrawnScene:
    """A scene from its plain data."""
    return DrawnScene.from_plain(from_json(to_json(drawn.plain())))


def moving_scene() -> ts.Scene:
    """Two beams, a load along a path, and obstacles of all shapes, of which two move along paths."""
    scene = beam_scene(("one", "two"))
    scene.bodies[0].add_traction(lambda c: c[:, 0] > 1.99, lambda t: (0.0, 20.0 * t, 50.0))
    scene.add_obstacle(ts.HalfSpace((0, -3, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Sphere((3, 0, 1), 0.4), name="ball", path=lambda t: ((0, t, 0), np.eye(3)))
    scene.add_obstacle(ts.Capsule((3, 1, 0), (3, 2, 0), 0.2), name="rod")
    scene.add_obstacle(ts.HalfSpace((-3, 0, 0), (1, 0, 0)), name="wall", path=lambda t: ((0.1 * t, 0, 0), np.eye(3)))
    box = ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5))
    scene.add_obstacle(ts.MeshObstacle(box.vertices + (0, 3, 0), box.surface), name="lid")
    scene.add_obstacle(ts.Box((0, -1.5, 0), (0.4, 0.1, 0.4)), name="slab")
    return scene


def connected_scene() -> ts.Scene:
    """A bar with a skin, under pressure, on a spring and a tendon, and attached to another bar by springs."""
    scene = beam_scene(("one", "two"))
    vertices = 0.2 * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    scene.body("one").embed(ts.SurfaceMesh(vertices, np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])))
    scene.body("two").add_pressure([0, 1, 2], lambda t: 50.0 + t)
    scene.add_spring(("one", (0, 0, 0)), ("two", (0, 0, 0)), stiffness=10.0, rest_length=0.5)
    scene.add_tendon([("one", (0.5, 0, 0)), ("two", (0.5, 0, 0)), ("two", (1, 0, 0))], 3.0)
    scene.add_rigid_body(ts.box_mesh((1, 1, 1), (0.4, 0.4, 0.4)), name="rigid", position=(4, 0, 0)).fix()
    return scene


def cubes_scene() -> ts.Scene:
    """Three cubes above one another, the first close to the ground, with which it has a friction of its own."""
    scene = ts.Scene()
    for k, name in enumerate("abc"):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(friction=0.5), name=name, position=(0, 2.0 * k, 0))
    scene.add_obstacle(ts.HalfSpace((0, -0.51, 0), (0, 1, 0)), name="ground", friction=0.5)
    scene.set_contact("a", "ground", friction=0.2)
    return scene
