"""Compiled MuJoCo models as URDF, for engines whose own readers of MJCF leave out classes, free joints and masses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ctxval._util.arrays import Array, Mask
from ctxval.errors import InputError

_SHAPES = ("plane", "height field", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")  # mjtGeom
_JOINTS = ("free", "ball", "slide", "hinge")  # mjtJoint
_NOWHERE, _UNTURNED = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Tree:
    """A robot with links ``b{body}`` and joints ``j{joint}``, or a geom ``g{geom}`` that stands still."""

    urdf: str
    fixed: bool = True
    position: Array = field(default_factory=lambda: np.zeros(3))  #: of the base in the world, metres
    quaternion: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))  #: of the base, w first
    is_geom: bool = False


def trees_of(model: Any, folder: Path) -> list[Tree]:
    """Return the robots and the fixed geoms of a ``mujoco.MjModel``; meshes are written to a folder.

    A joint of the URDF is 0 where the joint of the model has its reference ``qpos0``. Names are the kinds and ids.

    Raises:
        InputError: if the model has what URDF lacks: ball joints, equalities, height fields, ellipsoids.
    """
    import mujoco

    if model.neq:
        raise InputError("equality constraints of an MJCF cannot be converted: remove them.")
    if balls := [model.joint(k).name for k, kind in enumerate(model.jnt_type) if _JOINTS[kind] == "ball"]:
        raise InputError(f"ball joints of an MJCF cannot be converted: {', '.join(balls)}.")
    at_rest, weld, trees = mujoco.MjData(model), model.body_weldid, []
    mujoco.mj_kinematics(model, at_rest)
    for geom in np.flatnonzero(_collide(model) & (weld[model.geom_bodyid] == 0)):
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, at_rest.geom_xmat[geom])
        shape = _shape(model, geom, _NOWHERE, _UNTURNED, folder)
        link = _link(f"g{geom}", shape, model.geom_friction[geom, 0])
        trees.append(Tree(_robot(link), True, at_rest.geom_xpos[geom].copy(), quaternion, is_geom=True))
    for root in np.flatnonzero((weld != 0) & (weld[model.body_parentid] == 0)):
        free = _JOINTS[model.jnt_type[model.body_jntadr[root]]] == "free"
        base = root if free else model.body_parentid[root]
        links = "".join(_links(model, root, folder, _NOWHERE))
        robot = _robot(links if free else _link(f"b{base}") + links)
        trees.append(Tree(robot, not free, at_rest.xpos[base].copy(), at_rest.xquat[base].copy()))
    return trees


def touching(model: Any) -> Iterator[tuple[str, str, bool]]:
    """Return the names of each two links with shapes, and whether MuJoCo lets them touch."""
    weld, geoms, bodies = model.body_weldid, np.flatnonzero(_collide(model)), model.geom_bodyid
    names = {geom: f"b{bodies[geom]}" if weld[bodies[geom]] else f"g{geom}" for geom in geoms}
    excluded = {(int(each) >> 16, int(each) & 0xFFFF) for each in model.exclude_signature}
    named = {frozenset(map(int, each)) for each in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    touch: dict[tuple[str, str], bool] = {}
    for a, b in combinations(geoms, 2):
        (first, upper), (second, lower) = sorted(
            (weld[bodies[geom]], weld[model.body_parentid[weld[bodies[geom]]]]) for geom in (a, b)
        )
        of_family = first == second or (0 != first == lower) or (0 != second == upper)
        masked = (model.geom_contype[a] & model.geom_conaffinity[b]) or (
            model.geom_contype[b] & model.geom_conaffinity[a]
        )
        allowed = masked and not of_family and tuple(sorted((bodies[a], bodies[b]))) not in excluded
        if names[a] != names[b]:
            touch[names[a], names[b]] = bool(
                touch.get((names[a], names[b])) or allowed or frozenset((int(a), int(b))) in named
            )
    return ((a, b, let) for (a, b), let in touch.items())


def _collide(model: Any) -> Mask:
    named = np.isin(np.arange(model.ngeom), [model.pair_geom1, model.pair_geom2])
    return np.asarray((model.geom_contype != 0) | (model.geom_conaffinity != 0) | named)


def _links(model: Any, body: Any, folder: Path, parent_anchor: Array) -> Iterator[str]:
    """Return a body with all that it carries. The frame of its link is the body's, moved to its last joint's anchor.

    Several joints of a body are a chain of links without mass.
    """
    parent, first = f"b{model.body_parentid[body]}", model.body_jntadr[body]
    joints = [k for k in range(first, first + model.body_jntnum[body]) if _JOINTS[model.jnt_type[k]] != "free"]
    place, quaternion, anchor = model.body_pos[body] - parent_anchor, model.body_quat[body], _NOWHERE
    for joint in joints:
        moved = model.jnt_pos[joint] - anchor
        place = place + _matrix(quaternion) @ moved if joint == joints[0] else moved
        child = f"b{body}" if joint == joints[-1] else f"b{body}_{joint}"
        yield _joint(model, joint, parent, child, _origin(place, quaternion))
        if joint != joints[-1]:
            yield _link(child)
        parent, quaternion, anchor = child, _UNTURNED, model.jnt_pos[joint]
    if not model.body_jntnum[body]:
        ends = f'<parent link="{parent}"/><child link="b{body}"/>'
        yield f'<joint name="f{body}" type="fixed">{_origin(place, quaternion)}{ends}</joint>'
    geoms = np.flatnonzero(_collide(model) & (model.geom_bodyid == body))
    shapes = "".join(
        _shape(model, geom, model.geom_pos[geom] - anchor, model.geom_quat[geom], folder) for geom in geoms
    )
    inertial = _inertial(
        model.body_mass[body], model.body_inertia[body], model.body_ipos[body] - anchor, model.body_iquat[body]
    )
    yield _link(f"b{body}", shapes, model.geom_friction[geoms, 0].max(initial=0.0), inertial)
    for carried in np.flatnonzero(model.body_parentid == body):
        yield from _links(model, carried, folder, anchor)


def _robot(links: str) -> str:
    return f'<robot name="converted">{links}</robot>'


def _origin(place: Array, quaternion: Array) -> str:
    R = _matrix(quaternion)
    level = np.hypot(R[0, 0], R[1, 0])
    if level > 1e-9:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:  # an axis points up or down: any roll will do
        roll, yaw = 0.0, np.arctan2(-R[0, 1], R[1, 1])
    rpy = np.array([roll, np.arctan2(-R[2, 0], level), yaw])
    return f'<origin xyz="{_text(place)}" rpy="{_text(rpy)}"/>'


def _matrix(quaternion: Array) -> Array:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _text(values: Array) -> str:
    return " ".join(str(each) for each in values.tolist())


def _inertial(mass: float, inertia: Array, place: Array, quaternion: Array) -> str:
    xx, yy, zz = inertia
    moments = f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial>{_origin(place, quaternion)}<mass value="{mass}"/>{moments}</inertial>'


_MASSLESS = _inertial(0.0, _NOWHERE, _NOWHERE, _UNTURNED)


def _link(name: str, shapes: str = "", friction: float = 0.0, inertial: str = _MASSLESS) -> str:
    contact = f'<contact><lateral_friction value="{friction}"/></contact>'
    return f'<link name="{name}">{contact}{inertial}{shapes}</link>'


def _joint(model: Any, joint: int, parent: str, child: str, origin: str) -> str:
    slides, limited = _JOINTS[model.jnt_type[joint]] == "slide", bool(model.jnt_limited[joint])
    kind = "prismatic" if slides else "revolute" if limited else "continuous"
    low, high = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]] if limited else (0.0, -1.0)
    dof = model.jnt_dofadr[joint]
    return f"""<joint name="j{joint}" type="{kind}">{origin}<parent link="{parent}"/><child link="{child}"/>
        <axis xyz="{_text(model.jnt_axis[joint])}"/><limit lower="{low}" upper="{high}" effort="0" velocity="0"/>
        <dynamics damping="{model.dof_damping[dof]}" friction="{model.dof_frictionloss[dof]}"/></joint>"""


def _shape(model: Any, geom: Any, place: Array, quaternion: Array, folder: Path) -> str:
    kind, mesh, (a, b, c) = _SHAPES[model.geom_type[geom]], model.geom_dataid[geom], model.geom_size[geom]
    shapes = {
        "plane": '<plane normal="0 0 1"/>',
        "sphere": f'<sphere radius="{a}"/>',
        "capsule": f'<capsule radius="{a}" length="{2 * b}"/>',
        "cylinder": f'<cylinder radius="{a}" length="{2 * b}"/>',
        "box": f'<box size="{2 * a} {2 * b} {2 * c}"/>',
        "mesh": f'<mesh filename="m{mesh}.obj"/>',
    }
    if kind not in shapes:
        name = model.geom(int(geom)).name or int(geom)
        raise InputError(f"the {kind} {name} cannot be converted: take a capsule, a box or a mesh.")
    if kind == "mesh":
        points = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]] + 1
        lines = [*(f"v {_text(each)}" for each in points), *(f"f {_text(each)}" for each in faces)]
        (folder / f"m{mesh}.obj").write_text("\n".join(lines), encoding="ascii")
    return f"<collision>{_origin(place, quaternion)}<geometry>{shapes[kind]}</geometry></collision>"
