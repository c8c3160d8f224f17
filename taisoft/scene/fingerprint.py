"""Digests of a scene's parts, which tell, with its numbers, whether two scenes are the same."""

import dataclasses
import hashlib
import json
from collections.abc import Callable

import numpy as np

from taisoft.scene.body import Body
from taisoft.scene.connection_records import Connection, Point
from taisoft.scene.key_frames import KeyFrames, NodePath, ShapePath
from taisoft.scene.laws import LAWS
from taisoft.scene.loads import BodyLoad, LoadPath
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
        fingerprint[f"{type(one).__name__.lower()} '{one.name}'"] = digest(_parts(one))
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
        "loads": [x for load in body.loads for x in (load.kind, *_parts(load))],
    }


def _parts(one: BodyLoad | Connection) -> list:
    """Return the arguments that a load or a connection was made with, besides the numbers that may change."""
    parts = []
    for name, value in one.arguments.items():
        is_number = name in one.numbers and isinstance(value, (float, np.ndarray))
        parts += [name, *(["number"] if is_number else _plain(value))]
    return parts


def _plain(value) -> list:
    """Return comparable values of an argument: of a function only that it is one."""
    if isinstance(value, Point):
        return [value.owner, value.position]
    if isinstance(value, tuple):
        return [part for one in value for part in _plain(one)]
    if isinstance(value, KeyFrames):
        return [value.times, value.translations, value.rotations, value.pivot, value.smooth, value.release, value.values]
    return ["function"] if callable(value) else [value.item() if isinstance(value, np.generic) else value]


def _robot_parts(placed: PlacedRobot) -> list:
    """Return the values that define a robot and its place: arrays of its model, but not names of files, its start, its paths."""
    model = placed.robot.model
    arrays = [array for name in dir(model) if "path" not in name and isinstance(array := getattr(model, name), np.ndarray)]
    option = [getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")]
    numbers = [one if isinstance(one, np.ndarray) else float(one) for one in option if not callable(one)]
    paths = [part for k, load in placed.control.items() for part in (k, load.value, *_path_parts(load.path))]
    return [*arrays, *numbers, placed.robot.state, placed.position, placed.axes, placed.iterations, *paths]


def _path_parts(path: Callable | None) -> list:
    """Return the comparable values of a path, and of key frames the start in whose frame they are."""
    start = {NodePath: "starts", ShapePath: "center"}.get(type(path))
    is_known = start or isinstance(path, LoadPath)
    return _plain(path.frames if is_known else path) + ([getattr(path, start)] if start else [])


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
