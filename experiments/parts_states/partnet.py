"""Two states of an object of PartNet-Mobility, drawn in MuJoCo as PARIS draws its own: views from all around,
each state by cameras of its own, with depth and labels.

Without a display, set MUJOCO_GL=egl before starting Python.
"""

import io
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from PIL import Image

from gsjax.data import Sequence, Truth
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.geometry.joints import Joint

SCALE = 0.5  # PartNet's objects are 2 wide
DISTANCE, FOVY = 2.0, 40.0  # of the cameras, metres; degrees
CLOSED, OPEN = (0.0, 0.15), (0.5, 0.9)  # how far parts are open in the two states, of their range
BACKWARDS = 0.3  # share of the parts that are open first
UPRIGHT = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # PartNet's axes -> ours, with z up
MATERIALS, TEXELS = 6, 64  # the pictures of textures are not part of every copy of the data
LIGHTS = """<light pos="1 -1 3" dir="-.3 .3 -1" diffuse=".5 .5 .5" castshadow="false"/>
    <light pos="-2 1 1" dir=".8 -.4 -.4" diffuse=".3 .3 .3" castshadow="false"/>"""


class Link(NamedTuple):
    """What moves as one: its meshes, and the joint that holds it, if any.

    Attributes:
        meshes: files, and where each lies in the link.
        kind: of the joint, "revolute" or "prismatic"; None without one.
        axis, point: of the joint, in PartNet's axes.
        limits: of the joint, radians or units of PartNet.
    """

    meshes: list[tuple[Path, np.ndarray]]
    kind: str | None = None
    axis: np.ndarray | None = None
    point: np.ndarray = np.zeros(3)
    limits: tuple[float, float] = (0.0, 0.0)


def partnet(root: Path, seed: int, size: int = 320, views: int = 32) -> Sequence:
    """Two states of an object, RGB-D and labels: 0 what does not move, then the parts.

    Args:
        root: the folder with mobility.urdf.
        seed: of colours, how far parts are open, and cameras.
        size: pixels, of either side of a picture.
        views: number of pictures of each state.
    """
    random = np.random.default_rng(seed)
    links = read_links(root)
    movers = [name for name, link in links.items() if link.kind]
    model = model_of(links, random, size)
    joints = [joint_of(links[name], random) for name in movers]
    eyes = [[eye(random) for _ in range(views)] for _ in range(2)]
    viewmats = np.array([[look_at(one, np.zeros(3)) for one in of] for of in eyes])
    drawn = [draw(model, movers, [joint.values[t] for joint in joints], viewmats[t], size) for t in range(2)]
    colors, depths, labels = (np.stack(values) for values in zip(*drawn, strict=True))
    focal = 0.5 * size / np.tan(np.radians(FOVY / 2))
    ids = np.arange(1, len(movers) + 1)
    poses = np.stack([joint.motions() for joint in joints], axis=1)
    return Sequence(
        name=f"partnet_{root.name}_{seed}",
        camera_ids=tuple(range(views)),
        width=size,
        height=size,
        times=np.arange(2.0),
        frame_ids=(0, 1),
        Ks=np.broadcast_to(intrinsics(focal, size, size), (2, views, 3, 3)),
        viewmats=viewmats,
        load_image=lambda t, c: colors[t, c],
        load_depth=lambda t, c: depths[t, c],
        load_mask=lambda t, c: labels[t, c],
        truth=Truth(tuple(movers), ids, poses, joints=tuple(joints)),
    )


def read_links(root: Path) -> dict[str, Link]:
    """The links of mobility.urdf, by name.

    Raises:
        ValueError: a part hangs on another that moves, or its joint neither turns nor slides within limits.
    """
    urdf = ET.parse(root / "mobility.urdf").getroot()
    links = {
        link.get("name"): Link(
            [
                (root / visual.find("geometry/mesh").get("filename"), numbers(visual.find("origin"), "xyz"))
                for visual in link.findall("visual")
            ]
        )
        for link in urdf.findall("link")
    }
    for joint in urdf.findall("joint"):
        name, kind = joint.find("child").get("link"), joint.get("type")
        if kind not in ("fixed", "revolute", "prismatic"):
            raise ValueError(f"{root}: expected fixed, revolute and prismatic joints, found {kind} of {name}")
        if kind != "fixed":
            limit = joint.find("limit")
            links[name] = links[name]._replace(
                kind=kind,
                axis=numbers(joint.find("axis"), "xyz"),
                point=numbers(joint.find("origin"), "xyz"),
                limits=(float(limit.get("lower")), float(limit.get("upper"))),
            )
    for joint in urdf.findall("joint"):
        name, parent = joint.find("child").get("link"), joint.find("parent").get("link")
        if links[parent].kind:
            raise ValueError(
                f"{root}: expected parts that hang on what stands still, found {name} on {parent}"
            )
    return {name: link for name, link in links.items() if link.meshes}


def numbers(element: ET.Element | None, key: str) -> np.ndarray:
    """Three numbers of an element, 0 if there is none."""
    return np.zeros(3) if element is None else np.array([float(one) for one in element.get(key).split()])


def model_of(links: dict[str, Link], random: np.random.Generator, size: int) -> mujoco.MjModel:
    """The object, with a hinge or slide for each part that moves."""
    assets, files, bodies = [], {}, []
    for k in range(MATERIALS):
        files[f"texture{k}.png"] = grain(random)
        assets.append(
            f'<texture name="t{k}" type="cube" file="texture{k}.png"/>'
            f'<material name="m{k}" texture="t{k}" texuniform="true" texrepeat="2 2" specular=".1"/>'
        )
    for name, link in links.items():
        geoms = []
        for path, offset in link.meshes:
            mesh = trimesh.load(path, force="mesh", process=False)
            if not len(getattr(mesh, "faces", ())):
                continue
            points, key = SCALE * (mesh.vertices + offset) @ UPRIGHT.T, f"mesh{len(files)}"
            files[f"{key}.obj"] = (
                trimesh.Trimesh(points, mesh.faces, process=False).export(file_type="obj").encode()
            )
            material = len(files) % MATERIALS  # parts and frames share them
            assets.append(f'<mesh name="{key}" file="{key}.obj" inertia="shell"/>')
            geoms.append(
                f'<geom type="mesh" mesh="{key}" material="m{material}" contype="0" conaffinity="0"/>'
            )
        joint = ""
        if link.kind:
            kind = "hinge" if link.kind == "revolute" else "slide"
            joint = (
                f'<joint name="{name}" type="{kind}" axis="{spaced(UPRIGHT @ link.axis)}"/>'
                '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            )
        place = spaced(SCALE * UPRIGHT @ link.point)
        bodies.append(f'<body name="{name}" pos="{place}">{joint}{"".join(geoms)}</body>')
    xml = f"""<mujoco>
    <compiler angle="radian"/>
    <visual>
      <headlight ambient=".5 .5 .5" diffuse=".3 .3 .3" specular="0 0 0"/>
      <quality offsamples="8"/><global offwidth="{size}" offheight="{size}" fovy="{FOVY}"/>
      <map znear=".01" zfar="20"/>
    </visual>
    <asset>{"".join(assets)}</asset>
    <worldbody>{LIGHTS}{"".join(bodies)}</worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml, files)


def spaced(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def grain(random: np.random.Generator) -> bytes:
    """A picture of one colour with grain and stripes."""
    color, wave = random.uniform(0.25, 0.85, 3), random.uniform(0.2, 1.0)
    patches = np.kron(random.normal(size=(8, 8)), np.ones((TEXELS // 8, TEXELS // 8)))
    light = 0.05 * patches + 0.03 * random.normal(size=(TEXELS, TEXELS))
    light += 0.08 * np.sin(wave * np.arange(TEXELS))[:, None]
    pixels, file = np.clip(color + light[..., None], 0, 1), io.BytesIO()
    Image.fromarray((255 * pixels).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def joint_of(link: Link, random: np.random.Generator) -> Joint:
    """The joint of a part, and how far it is open in the two states."""
    low, high = link.limits
    values = low + (high - low) * np.array([random.uniform(*CLOSED), random.uniform(*OPEN)])
    if random.uniform() < BACKWARDS:
        values = values[::-1]
    scale = 1.0 if link.kind == "revolute" else SCALE
    return Joint(link.kind, UPRIGHT @ link.axis, SCALE * UPRIGHT @ link.point, scale * values)


def eye(random: np.random.Generator) -> np.ndarray:
    """A place around the object, from a little below its middle to above it."""
    azimuth, height = random.uniform(0, 2 * np.pi), random.uniform(-0.1, 0.95)
    flat = np.sqrt(1 - height**2)
    return DISTANCE * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])


def draw(
    model: mujoco.MjModel, movers: list[str], values: list[float], viewmats: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures [C, H, W, 3] on black, depths and labels of one state."""
    data, renderer = mujoco.MjData(model), mujoco.Renderer(model, size, size)
    for name, value in zip(movers, values, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    bodies = [model.body(body).name for body in model.geom_bodyid]
    labels = np.array([movers.index(name) + 1 if name in movers else 0 for name in bodies])
    drawn = [shot(renderer, data, viewmat, labels) for viewmat in viewmats]
    renderer.close()
    return tuple(np.stack(values) for values in zip(*drawn, strict=True))


def shot(
    renderer: mujoco.Renderer, data: mujoco.MjData, viewmat: np.ndarray, labels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What one camera sees."""
    camera = mujoco.MjvCamera()
    forward = viewmat[2, :3]
    camera.type, camera.distance = mujoco.mjtCamera.mjCAMERA_FREE, DISTANCE
    camera.lookat[:] = -viewmat[:3, :3].T @ viewmat[:3, 3] + DISTANCE * forward
    camera.azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
    camera.elevation = np.degrees(np.arcsin(forward[2]))
    renderer.update_scene(data, camera)
    color = renderer.render().copy()
    renderer.enable_depth_rendering()
    depth = renderer.render().copy()
    renderer.disable_depth_rendering()
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, camera)
    geom = renderer.render()[..., 0].copy()
    renderer.disable_segmentation_rendering()
    there = geom >= 0
    label = np.where(there, labels[np.maximum(geom, 0)], 0)
    return color * there[..., None], np.where(there, depth, 0).astype(np.float32), label
