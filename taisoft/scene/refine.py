"""Refine a scene's meshes by splitting every tet into eight, or change its element order; all else is kept.

Old nodes keep their positions and come first; new nodes are edge midpoints, so two solutions can be compared node by node. The
geometry stays that of the mesh, curved edges included: new nodes of a ball do not move to the sphere. Functions that choose nodes
are evaluated again.
For nodes chosen by id, a midpoint is chosen if its edge belongs to a surface triangle or tet whose nodes are all chosen; if
only the two ends are chosen, the case is ambiguous and refused. Tractions and pressures pass to the parts of their triangles.
Forces given per node stay point forces. The stiffness and damping of an attachment stay the same in all: each of its nodes gets
less if there are more of them.
"""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.mesh.nodes import PARTS, Nodes, make_nodes, part_coordinates
from taisoft.mesh.quadratic import shape_functions
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import EDGES, distinct_edges
from taisoft.scene.body import Body, Constraint
from taisoft.scene.connection_records import Attachment
from taisoft.scene.key_frames import KeyFrames, NodePath
from taisoft.scene.loads import BodyLoad
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene


def refined(scene: Scene) -> Scene:
    """Return the scene with every tet split into eight. Raises SceneError if a constraint or load cannot be transferred."""
    return _with_bodies(
        scene, [_same(body) if isinstance(body, RigidBody) else _refined(body) for body in scene.bodies], finer=2.0
    )


def with_order(scene: Scene, order: int) -> Scene:
    """Return the scene with all bodies of order 1 or 2. Raises SceneError as `refined` does."""
    kept = [isinstance(body, RigidBody) or body.order == order for body in scene.bodies]
    return _with_bodies(scene, [_same(body) if keep else _of_order(body, order) for body, keep in zip(scene.bodies, kept)])


def _same(body: Body) -> tuple[Body, np.ndarray]:
    return copy.copy(body), _own_parents(body.n_nodes)


def _with_bodies(scene: Scene, made: list[tuple[Body, np.ndarray]], finer: float = 1.0) -> Scene:
    """Return the scene with other bodies. made: each with the two old nodes that each of its nodes bisects; finer: old over new
    heights of tets."""
    copied, by_name = scene.snapshot(), {body.name: (body, parents) for body, parents in made}
    attachments = []
    for one in scene.attachments:
        new, parents = by_name[one.a]
        if isinstance(new, RigidBody):
            attachments.append(replace(one, reach=finer * one.reach))
            continue
        where = _chosen(scene.body(one.a), one, parents)
        nodes = new.select_nodes(where, f"attachment {one.name!r}")
        share = len(one.nodes) / len(nodes)
        stiffness = None if one.stiffness is None else share * one.stiffness
        changed = {"stiffness": stiffness, "damping": share * one.damping, "reach": finer * one.reach}
        attachments.append(replace(one, nodes=nodes, **changed))
    with thawed(copied):
        copied.bodies, copied.attachments = [body for body, _ in made], attachments
    return copied


def _refined(old: Body) -> tuple[Body, np.ndarray]:
    split = make_nodes(old.mesh, 2, old.rest_positions[old.mesh.n_verts : old.nodes.n_elastic] if old.is_curved else None)
    regions = None if old.mesh.regions is None else np.repeat(old.mesh.regions, PARTS)
    fibres = None if old.mesh.fibres is None else np.repeat(old.mesh.fibres, PARTS, axis=0)
    labels = {"regions": regions, "region_names": old.mesh.region_names, "fibres": fibres}
    mesh = TetMesh(split.positions, split.tets, mid_edge=_middles_of_parts(split) if old.is_curved else None, **labels)
    edges, _ = distinct_edges(mesh.tets if old.order == 2 else old.mesh.tets)
    parents_of_nodes = np.concatenate([_own_parents(old.nodes.n_elastic), edges])
    new = _on_mesh(old, mesh, old.order, parents_of_nodes)
    # Row of the new surface -> triangle of the old one: split.surface lists the four parts of each triangle in sequence.
    rows = {tuple(sorted(t)): k // 4 for k, t in enumerate(split.surface.tolist())}
    parents = np.array([rows[tuple(sorted(t))] for t in mesh.surface.tolist()])
    _add_loads(new, old, parents_of_nodes, lambda triangles: np.isin(parents, triangles))
    return new, parents_of_nodes


def _middles_of_parts(split: Nodes) -> np.ndarray:
    """Return where curved elements map the midpoints of the edges of their parts, in the order of `distinct_edges` (k,3) [m]."""
    points = part_coordinates(split)[:, EDGES].mean(axis=2).reshape(-1, 4)
    weights = shape_functions(2, points).reshape(len(split.elements), -1, 10)
    edges, edge_of_part = distinct_edges(split.tets)
    middles = np.empty((len(edges), 3))
    middles[edge_of_part.reshape(-1)] = (weights @ split.positions[split.elements]).reshape(-1, 3)
    return middles


def _of_order(old: Body, order: int) -> tuple[Body, np.ndarray]:
    parents = _own_parents(old.mesh.n_verts)
    if order == 2:
        parents = np.concatenate([parents, distinct_edges(old.mesh.tets)[0]])
    new = _on_mesh(old, old.mesh, order, parents)
    _add_loads(new, old, parents, lambda triangles: triangles)
    return new, parents


def _add_loads(new: Body, old: Body, parents: np.ndarray, chosen: Callable[[np.ndarray], np.ndarray]) -> None:
    """Add the loads of the old body. parents: see `_on_mesh`; chosen: old triangles -> what chooses the new ones."""
    for load in old.loads:
        if load.items == "triangles":
            where = chosen(load.ids)
        elif (load.path_shape if load.value is None else load.value.shape) == (len(load.ids), 3):  # by node
            where = load.ids
            if where.max() >= new.nodes.n_elastic or not (parents[where] == where[:, None]).all():
                raise SceneError(f"body {old.name!r}: linear tets have no mid-edge nodes for its forces")
        else:
            where = _chosen(old, load, parents)
        new.add_load(load.kind, **load.arguments | {"where": where})


def _own_parents(n: int) -> np.ndarray:
    return np.repeat(np.arange(n)[:, None], 2, axis=1)


def _on_mesh(old: Body, mesh: TetMesh, order: int, parents: np.ndarray) -> Body:
    """Return the body on another mesh, without loads. parents: (n,2), the old nodes that each new one bisects."""
    velocity = old.velocity if old.velocity.shape == (3,) else old.velocity[parents].mean(axis=1)
    degree = old.quadrature_degree if order == old.order else None
    copies = mesh.n_tets // old.mesh.n_tets
    numbers = {name: np.repeat(values, copies) for name, values in old.composition.by_tet.items()}
    fibres = None if old.fibres is None else np.repeat(old.fibres, copies, axis=0)
    curve = "straight" if order == 2 and not old.is_curved else None  # None: the mesh's mid-edge nodes
    kept = old.collision, old.given_dilatation, fibres, curve
    new = Body(old.name, mesh, old.material, old.position, velocity, order, degree, *kept, **numbers)
    with thawed(new):
        new.activations = old.activations
        if order == old.order:  # as decided, whatever numbers have changed since
            new.dilatation = old.dilatation
    if old.skin is not None:
        new.embed(old.skin.surface, old.skin.contact)
    for constraint in old.constraints:
        axes = "".join(axis for axis, held in zip("xyz", constraint.axes) if held)
        where = _chosen(old, constraint, parents)
        if constraint.path is None:
            new.fix(where, axes)
        else:
            new.move(where, _path(old, constraint), axes)
    return new


def _chosen(old: Body, item: Constraint | BodyLoad | Attachment, parents: np.ndarray):
    """Return the selection of new nodes: the function that chose the old ones, or ids (k,)."""
    if item.where is not None:
        return item.where
    selected = np.zeros(old.nodes.n_elastic, dtype=bool)
    selected[item.nodes] = True
    chosen = selected[parents].all(axis=1)
    inner = chosen & (parents[:, 0] != parents[:, 1])
    whole = [set(map(tuple, _edges_of(cells[selected[cells].all(axis=1)]))) for cells in (old.nodes.boundary, old.nodes.tets)]
    for a, b in np.sort(parents[inner], axis=1).tolist():
        if (a, b) not in whole[0] and (a, b) not in whole[1]:
            raise SceneError(
                f"body {old.name!r}: nodes {a} and {b} are chosen by id, and whether the midpoint of their edge is chosen too is "
                "ambiguous, since no surface triangle or tet with that edge is chosen as a whole: choose by a function"
            )
    if not chosen.any():
        raise SceneError(f"body {old.name!r}: only mid-edge nodes are chosen, which linear tets do not have")
    return np.flatnonzero(chosen)


def _edges_of(cells: np.ndarray) -> list:
    """Return ascending vertex pairs of triangles (k,3) or tets (k,4), with repetitions."""
    a, b = np.triu_indices(cells.shape[1], 1)
    return np.sort(np.stack([cells[:, a], cells[:, b]], axis=2).reshape(-1, 2), axis=1).tolist()


def _path(old: Body, constraint: Constraint):
    """Return the path for any number of nodes; key frames without a pivot keep the old nodes' mean as pivot."""
    path = constraint.path
    if isinstance(path, NodePath):
        frames: KeyFrames = path.frames
        return frames if frames.pivot is not None else replace(frames, pivot=path.starts.mean(axis=0))
    if np.shape(path(0.0)) != (3,):
        raise SceneError(
            f"body {old.name!r}: a path returns one displacement for each of its {len(constraint.nodes)} nodes, and none for "
            "new nodes: move them by KeyFrames"
        )
    return path
