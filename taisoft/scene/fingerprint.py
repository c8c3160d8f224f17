"""Digests of a scene's parts, which tell, with its numbers, whether two scenes are the same."""

import dataclasses
import hashlib
import json
from collections.abc import Callable

import numpy as np

from taisoft.scene.body import Body
from taisoft.scene.connection_records import Attachment, Connection, Tendon
from taisoft.scene.key_frames import NodePath, ShapePath
from taisoft.scene.laws import LAWS
from taisoft.scene.loads import LoadPath
from taisoft.scene.numbers import scene_numbers
from taisoft.scene.rigid import RigidBody
from taisoft.scene.robot import PlacedRobot
from taisoft.scene.scene import Scene

FEATURES = "the features that it needs"  # last entry of a fingerprint: of the plan, which follows from the parts and numbers


def scene_fingerprint(scene: Scene, features: dict[str, bool]) -> dict[str, str]:
    """Return a digest of each part of a scene that must be unchanged when a run resumes, by the part's name in messages."""
    fingerprint = {  # in the order added, which numbers nodes
        "bodies": json.dumps([body.name for body in scene.bodies]),
        "obstacles": json.dumps([o.name for o in scene.obstacles]),
    }
    for body in scene.bodies:
        owner = f"body '{body.name}'"
        for part, values in _body_parts(body).items():
            fingerprint[f"{owner}: {part}"] = digest(values)
    for obstacle in scene.obstacles:
        owner, shape = f"obstacle '{obstacle.name}'", obstacle.shape
        values = [getattr(shape, field.name) for field in dataclasses.fields(shape)]
        fingerprint[f"{owner}: shape or path"] = digest([type(shape).__name__, *values, *_path_parts(obstacle.given_path)])
    for one in scene.connections:
        fingerprint[f"{type(one).__name__.lower()} '{one.name}'"] = digest(_connection_parts(one))
    for placed in scene.robots:
        fingerprint[f"robot '{placed.name}'"] = digest(_robot_parts(placed))
    fingerprint["collision settings"] = digest([json.dumps(dataclasses.asdict(scene.collision)), scene.contact_forces])
    # features unused at the start, such as damping 0, are compiled out
    fingerprint[FEATURES] = digest([json.dumps(features)])
    return fingerprint


def scene_digest(scene: Scene) -> str:
    """Return a digest of everything comparable in a scene: its parts as a checkpoint compares them, and its numbers."""
    numbers = json.dumps(scene_numbers(scene), default=lambda array: digest([array]), sort_keys=True)
    return digest([json.dumps(scene_fingerprint(scene, {})), numbers, scene.allow_initial_overlap])


def _body_parts(body: Body) -> dict[str, list]:
    """Return the values that define a body, by the part's name in messages."""
    rigid = isinstance(body, RigidBody)  # its law and its stiffness are chosen by the Simulator
    materials = [] if rigid else body.composition.materials.values()
    laws = [part for one in materials for part in (one.law, *LAWS[one.law].fingerprint())]
    laws += [material.branches for material in materials] if any(material.branches for material in materials) else []
    constraints = sorted(body.constraints, key=lambda c: c.path is not None)  # scene files have `fix` first
    return {
        "mesh": [body.mesh.vertices, body.mesh.tets] + [body.rest_positions] * body.is_curved,
        "surface": [body.rest_positions[body.nodes.n_elastic :], body.nodes.surface] if body.nodes.embedded is not None else [],
        "skin": [] if body.skin is None else [body.skin.surface.vertices, body.skin.surface.triangles, body.skin.contact],
        "regions": [body.mesh.regions, list(body.composition.materials)] if body.composition.has_regions else [],
        "order, quadrature, dilatation, law, branches or collision": [
            body.order,
            body.quadrature_degree,
            body.dilatation,
            laws,
            body.collision,
        ],
        **({} if body.fibres is None else {"fibres": [body.fibres, *(x for a in body.activations for x in _path_parts(a.path))]}),
        "start": [body.position, body.velocity],
        "constraints": [x for c in constraints for x in (c.nodes, c.axes, *_path_parts(c.path))],
        "loads": [
            *(x for t in body.tractions for x in ("traction", t.triangles, *_path_parts(t.path))),
            *(x for f in body.forces for x in ("force", f.nodes, *_path_parts(f.path))),
            *(x for p in body.pressures for x in ("pressure", p.triangles, *_path_parts(p.path))),
            *(x for c in body.cavities for x in ("cavity", c.name, c.given, c.triangles, *_path_parts(c.path))),
        ],
    }


def _connection_parts(one: Connection) -> list:
    """Return the values that define a connection besides its numbers."""
    if isinstance(one, Attachment):
        return [one.a, one.nodes, one.b, one.stiffness is None]
    points = [part for point in one.points for part in (point.owner, point.position)]
    return [*points, one.given, one.stiffness is None, *_path_parts(one.path)] if isinstance(one, Tendon) else points


def _robot_parts(placed: PlacedRobot) -> list:
    """Return the values that define a robot and its place: arrays of its model, but not names of files, its start, its paths."""
    model = placed.robot.model
    arrays = [array for name in dir(model) if "path" not in name and isinstance(array := getattr(model, name), np.ndarray)]
    option = [getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")]
    numbers = [one if isinstance(one, np.ndarray) else float(one) for one in option if not callable(one)]
    paths = [part for k, load in placed.control.items() for part in (k, load.value, *_path_parts(load.path))]
    return [*arrays, *numbers, placed.robot.state, placed.position, placed.axes, placed.iterations, *paths]


def _path_parts(path: Callable | None) -> list:
    """Return the comparable values of a path: the data of key frames; of another function only that it exists."""
    if not isinstance(path, (NodePath, ShapePath, LoadPath)):
        return [path is None]
    frames = path.frames
    values = [frames.times, frames.translations, frames.rotations, frames.pivot, frames.smooth, frames.release, frames.values]
    start = {NodePath: "starts", ShapePath: "center"}.get(type(path))  # in whose frame key frames are
    return values + ([getattr(path, start)] if start else [])


def digest(values: list) -> str:
    """Return the SHA-256 (hex) of arrays and plain values."""
    sha256 = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            sha256.update(f"{value.dtype.str} {value.shape} ".encode())
            sha256.update(np.ascontiguousarray(value))
        else:
            sha256.update(json.dumps(value).encode())
    return sha256.hexdigest()
