"""Scenes of the BOP benchmark (Hodan et al. 2018, bop_datasets_format.md): one RGB-D camera, posed objects.

scene_camera.json          by frame: cam_K (pixel centres at integers), depth_scale (millimetres per step),
                           optionally cam_R_w2c and cam_t_w2c (world to camera, OpenCV axes, millimetres)
scene_gt.json              optional; by frame, for each instance: obj_id, cam_R_m2c, cam_t_m2c (model to
                           camera)
rgb/FRAME.png              or .jpg; or gray/
depth/FRAME.png            uint16, 0 = invalid, optional
mask_visib/FRAME_I.png     the visible part of instance I of the frame's list in scene_gt.json, optional
../../models_eval/         models of the objects, optional; see `gsjax.data.bop_files`

Instances are numbered within a frame only, so each is tracked from frame to frame: the only instance of an
object by the object's number, several instances of an object by their positions in the world, assigned with
the least sum of squared distances.
"""

import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gsjax.data.bop_files import MM, by_number, read_models
from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import image_size, read_depth, read_image
from gsjax.data.frame_folders import DEFAULT_RATE_HZ, numbered
from gsjax.data.masks import read_shades
from gsjax.data.objects import Truth
from gsjax.data.origin import near_origin
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_intrinsics, check_poses
from gsjax.io.brief import shortened

CAMERAS, POSES = "scene_camera.json", "scene_gt.json"
_STATIC_CAMERA = "camera"


class _View(NamedTuple):
    """The camera of a frame: K with pixel centres at +0.5, metres per depth step, and world to camera if that
    is known."""

    K: Float[np.ndarray, "3 3"]
    depth_unit_m: float
    viewmat: Float[np.ndarray, "4 4"] | None


class _Instance(NamedTuple):
    """An object in a frame: its number, and model to camera in metres."""

    number: int
    pose: Float[np.ndarray, "4 4"]


@near_origin
def read_bop(path: str | Path, *, world: str | None = None, depth_unit_m: float | None = None) -> Sequence:
    """The scene in a folder of this layout (such as test/000001): one camera, 0; times are frame numbers at
    30 Hz.

    Masks have labels 1, 2, ..., in order of object numbers; an instance keeps its label from frame to frame,
    and `names_of_labels` names it by its model's file. The truth has the poses of those instances that are
    annotated in all frames; the others keep their masks, and a DataWarning counts them. Frames without a
    camera, its pose, an image, depth or annotations are left out, with a DataWarning that counts them.

    Args:
        path: the folder.
        world: what is static if the data have no camera poses: "camera", or the number of an object with one
            instance, whose frame is then the world. It takes precedence over poses in the data.
        depth_unit_m: metres per depth step; None: by depth_scale of each frame.

    Raises:
        DataError: the folder holds several scenes or one of several cameras, a file is missing or malformed,
            no frame is complete, or the camera has no poses and `world` is not given.
        ValueError: `world` is neither "camera" nor an object, or a pose is not a rigid motion.
    """
    root = Path(path)
    _check_is_one_scene(root)
    views = by_number(root / CAMERAS, _view)
    images = numbered(root / "rgb") or numbered(root / "gray")
    depths, annotated = numbered(root / "depth"), (root / POSES).exists()
    instances = by_number(root / POSES, _instances) if annotated else {}
    _check(root / POSES, {n: [i.pose for i in some] for n, some in instances.items()}, "Correct that entry.")
    viewmats = _viewmats(root, views, instances, world)
    parts = {"a camera": views, "an image": images, "depth": depths or None}
    parts |= {"annotations": instances if annotated else None, "a pose of the camera": viewmats}
    numbers = _complete_frames(root, sorted(views.keys() | images.keys()), parts)
    followed = _Tracks.over([instances.get(n, []) for n in numbers], [viewmats[n] for n in numbers])
    Ks = np.stack([views[n].K for n in numbers])[:, None]
    check_intrinsics(Ks, lambda t, _: f"frame {numbers[t]} in {root / CAMERAS}")
    width, height = image_size(images[numbers[0]])
    files = {"image": images, "depth": depths}

    def load_depth(t: int, c: int) -> Float[np.ndarray, "height width"]:
        unit = depth_unit_m or views[numbers[t]].depth_unit_m
        return read_depth(depths[numbers[t]], unit, width, height)

    def load_mask(t: int, c: int) -> Int[np.ndarray, "height width"] | None:
        labelled = zip(masks[t], followed.labels[t], strict=True)
        found = [(file, label) for file, label in labelled if file is not None]
        if not found and masks[t]:
            return None
        labels = np.zeros((height, width), np.int32)
        for file, label in found:
            labels[read_shades(file, width, height) > 0] = label
        return labels

    masks = _masks(root, [(n, len(instances.get(n, []))) for n in numbers])
    return Sequence(
        name=_name(root.resolve()),
        camera_ids=(0,),
        width=width,
        height=height,
        times=np.array(numbers) / DEFAULT_RATE_HZ,
        frame_ids=tuple(numbers),
        Ks=Ks,
        viewmats=np.stack([viewmats[n] for n in numbers])[:, None],
        load_image=lambda t, c: read_image(images[numbers[t]], width, height),
        load_depth=load_depth if depths else None,
        load_mask=load_mask if masks else None,
        truth=followed.truth(root) if annotated else None,
        label_names=followed.names,
        locate=lambda kind, t, c: str(
            root / "mask_visib" / f"{numbers[t]:06d}_*.png"
            if kind == "mask"
            else files[kind].get(numbers[t], root / kind / f"{numbers[t]:06d}.png")
        ),
    )


def _name(root: Path) -> str:
    """The folder's name, preceded by that of the split if it is a mere number."""
    return f"{root.parent.name}_{root.name}" if root.name.isdecimal() else root.name


def _check_is_one_scene(root: Path) -> None:
    if (root / CAMERAS).is_file():
        return
    scenes = sorted(file.parent.name for file in root.glob(f"*/{CAMERAS}"))
    several = sorted(file.name for file in root.glob("scene_camera_*.json"))
    if scenes:
        found, advice = f"the scenes {shortened(scenes, 8)}", f"Pass one of them, such as {root / scenes[0]}."
    elif several:
        found = f"a scene of several cameras ({shortened(several)})"
        advice = "Only scenes of one camera are read: rename the files and folders of one to the plain names."
    else:
        found, advice = f"no {CAMERAS}", "Pass the folder of a scene."
    raise DataError(root, "one scene of the BOP layout", found, advice)


def _view(entry: dict[str, Any]) -> _View:
    K = np.array(entry["cam_K"], np.float64).reshape(3, 3)
    K[:2, 2] += 0.5  # from pixel centres at integers
    scale = float(entry.get("depth_scale", 1.0))
    if not 0 < scale < np.inf:
        raise ValueError(f"depth_scale is {scale}")
    known = entry.get("cam_R_w2c") is not None
    return _View(K, MM * scale, _pose(entry, "cam_R_w2c", "cam_t_w2c") if known else None)


def _instances(entries: list[dict[str, Any]]) -> list[_Instance]:
    return [_Instance(int(entry["obj_id"]), _pose(entry, "cam_R_m2c", "cam_t_m2c")) for entry in entries]


def _pose(entry: dict[str, Any], rotation: str, translation: str) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3] = np.array(entry[rotation], np.float64).reshape(3, 3)
    pose[:3, 3] = MM * np.array(entry[translation], np.float64).reshape(3)
    return pose


def _check(path: Path, poses: dict[int, list[np.ndarray]], advice: str) -> None:
    """Raises ValueError if a pose is not a rigid motion; the message names file, frame and entry."""
    places = [(number, i) for number, some in poses.items() for i in range(len(some))]
    if places:
        matrices = np.stack([poses[number][i] for number, i in places])[:, None]
        check_poses(
            "pose", matrices, lambda at, _: "entry {1} of frame {0} in {2}".format(*places[at], path), advice
        )


def _viewmats(
    root: Path, views: dict[int, _View], instances: dict[int, list[_Instance]], world: str | None
) -> dict[int, Float[np.ndarray, "4 4"]]:
    """World to camera, metres, in each frame where it is known."""
    objects = sorted({instance.number for some in instances.values() for instance in some})
    if world == _STATIC_CAMERA:
        return {number: np.eye(4) for number in views}
    if world is not None:
        if not world.isdecimal() or int(world) not in objects:
            listed = f"the number of an object ({shortened(map(str, objects), 8)})"
            raise ValueError(f"{root}: world must be {_STATIC_CAMERA} or {listed}, got {world!r}")
        own = {n: [i.pose for i in some if i.number == int(world)] for n, some in instances.items()}
        if several := [n for n, poses in own.items() if len(poses) > 1]:
            expected = f"one object {world}, as it is to be the world"
            raise DataError(
                root / POSES, expected, f"several in frame {several[0]}", "Choose another object."
            )
        return {n: poses[0] for n, poses in own.items() if poses}
    known = {n: view.viewmat for n, view in views.items() if view.viewmat is not None}
    if views and not known:
        choices = f" or an object that does ({shortened(map(str, objects), 8)})" if objects else ""
        advice = f"Set world (--read.world) to what stands still: {_STATIC_CAMERA}{choices}."
        raise DataError(root / CAMERAS, "poses of the camera (cam_R_w2c, cam_t_w2c)", "none", advice)
    _check(root / CAMERAS, {n: [pose] for n, pose in known.items()}, "Correct it, or remove that frame.")
    return known


def _complete_frames(root: Path, frames: list[int], parts: dict[str, dict | None]) -> list[int]:
    """Numbers of the frames that have every part; None stands for a part that the data lacks altogether."""
    numbers, left_out = frames, []
    for what, known in parts.items():
        lacking = [] if known is None else [n for n in numbers if n not in known]
        numbers = [n for n in numbers if n not in set(lacking)]
        if lacking:
            left_out.append(f"{len(lacking)} without {what} ({shortened(f'{n:06d}' for n in lacking)})")
    if not numbers:
        found = f"none of {len(frames)}: {', '.join(left_out)}" if left_out else "none"
        raise DataError(root, "frames with image, depth, annotations and camera", found, COMPLETE)
    if left_out:
        count = len(frames) - len(numbers)
        message = f"{root}: {count} of {len(frames)} frames are left out: {', '.join(left_out)}"
        warnings.warn(message, DataWarning, stacklevel=3)
    return numbers


def _masks(root: Path, counts: list[tuple[int, int]]) -> list[list[Path | None]]:
    """The mask of each instance of each frame, None if it does not exist; empty if no mask exists."""
    folder = root / "mask_visib"
    known = set(os.listdir(folder)) if folder.is_dir() else set()
    names = [[f"{number:06d}_{i:06d}.png" for i in range(count)] for number, count in counts]
    missing = [name for some in names for name in some if name not in known]
    total = sum(map(len, names))
    if not known or len(missing) == total:
        if known:
            message = f"{folder}: no mask belongs to an instance in {POSES}; all are left out"
            warnings.warn(message, DataWarning, stacklevel=3)
        return []
    if missing:
        message = f"{folder}: {len(missing)} of {total} masks do not exist ({shortened(missing)})"
        advice = "those instances are left out of the masks of these frames"
        warnings.warn(f"{message}; {advice}", DataWarning, stacklevel=3)
    return [[folder / name if name in known else None for name in some] for some in names]


class _Tracks(NamedTuple):
    """Instances tracked over frames, with labels that they keep.

    Attributes:
        labels: the label of each instance of each frame.
        names: the name of each label.
        numbers: the object's number, by label.
        poses: object to world, by label, then by position of the frame.
        frames: number of frames.
    """

    labels: list[list[int]]
    names: dict[int, str]
    numbers: dict[int, int]
    poses: dict[int, dict[int, np.ndarray]]
    frames: int

    @classmethod
    def over(cls, frames: list[list[_Instance]], viewmats: list[np.ndarray]) -> "_Tracks":
        """Track the instances of each object over frames."""
        tracks: dict[int, list[dict[int, int]]] = {}  # by object: position of the frame -> place in its list
        worlds = [
            [np.linalg.solve(viewmat, instance.pose) for instance in some]
            for some, viewmat in zip(frames, viewmats, strict=True)
        ]
        for t, some in enumerate(frames):
            for number in {instance.number for instance in some}:
                mine = [i for i, instance in enumerate(some) if instance.number == number]
                _extend(tracks.setdefault(number, []), t, mine, worlds)
        labels, names, numbers, poses = [[0] * len(some) for some in frames], {}, {}, {}
        for number in sorted(tracks):
            for k, track in enumerate(tracks[number]):
                label = len(names) + 1
                numbers[label] = number
                names[label] = f"obj_{number:06d}" + (f"_{k + 1}" if len(tracks[number]) > 1 else "")
                poses[label] = {t: worlds[t][i] for t, i in track.items()}
                for t, i in track.items():
                    labels[t][i] = label
        return cls(labels, names, numbers, poses, len(frames))

    def truth(self, root: Path) -> Truth | None:
        """The poses of the instances that are in all frames, and their models; None if there is none."""
        always = [label for label, poses in self.poses.items() if len(poses) == self.frames]
        if left_out := [self.names[label] for label in self.names if label not in always]:
            some = (
                f"{len(left_out)} of {len(self.names)} objects are not in all frames ({shortened(left_out)})"
            )
            message = f"{root / POSES}: {some}; they are left out of the true poses"
            warnings.warn(message, DataWarning, stacklevel=3)
        if not always:
            return None
        poses = [[self.poses[label][t] for label in always] for t in range(self.frames)]
        known = read_models(root.resolve().parent.parent, {self.numbers[label] for label in always})
        return Truth(
            names=tuple(self.names[label] for label in always),
            label_ids=np.array(always),
            poses=np.array(poses),
            models=tuple(known.get(self.numbers[label]) for label in always) if known else (),
        )


def _extend(tracks: list[dict[int, int]], t: int, places: list[int], worlds: list[list[np.ndarray]]) -> None:
    """Assign the instances of an object in frame `t` to its tracks, by the least squared distances from where
    those were last; the rest start new tracks."""
    from scipy.optimize import linear_sum_assignment  # slow to import

    last = np.array([worlds[u := max(track)][track[u]][:3, 3] for track in tracks]).reshape(-1, 3)
    now = np.array([worlds[t][i][:3, 3] for i in places])
    rows, columns = linear_sum_assignment(np.square(last[:, None] - now).sum(-1))
    for row, column in zip(rows, columns, strict=True):
        tracks[row][t] = places[column]
    tracks += [{t: places[i]} for i in range(len(places)) if i not in columns]
