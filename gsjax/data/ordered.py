"""A recording from photographs that one camera took in succession, for example the frames of a video whose
poses were estimated by structure from motion."""

import numpy as np

from gsjax.data.errors import DataError
from gsjax.data.frame_folders import DEFAULT_RATE_HZ, natural_key
from gsjax.data.open import ReadOptions, is_only_photographs, open_photographs, open_sequence
from gsjax.data.photographs import Photographs
from gsjax.data.sequence import Sequence
from gsjax.data.tool_masks import LABEL_NAMES, TISSUE, TOOL


def open_as_sequence(dataset: str, read: ReadOptions | None = None) -> Sequence:
    """Open a recording, or a set of photographs as one, such as `gsjax poses` writes for a video.

    Raises:
        DataError: the data cannot be read, or photographs differ in size.
    """
    read = read or ReadOptions()
    if is_only_photographs(dataset, read.images):
        return sequence_of(open_photographs(dataset, read))
    return open_sequence(dataset, read)


def sequence_of(photographs: Photographs) -> Sequence:
    """The photographs as frames of camera 0, in order of their times or, without times, of their names. They
    may share times, as those of D-NeRF's splits do. Pixels that masks exclude are labelled as tool. Lengths
    stay in the photographs' unit.

    Raises:
        DataError: the photographs differ in size, or are fisheye photographs that are kept as they are.
    """
    if photographs.fisheye is not None:
        raise DataError(
            photographs.name,
            "photographs of pinholes, as recordings have them",
            "fisheyes that are kept as they are",
            "Leave out --read.fisheye, and they are undistorted.",
        )
    times, names = photographs.times, photographs.names
    if times is None:
        order = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
    else:
        order = np.argsort(np.asarray(times), kind="stable").tolist()
    width, height = (int(side) for side in photographs.sizes[order[0]])
    other = next((i for i in order if tuple(photographs.sizes[i]) != (width, height)), None)
    if other is not None:
        found = "{}x{} in {}".format(*photographs.sizes[other], names[other])
        advice = "A recording comes from one camera; remove the photographs of other sizes."
        raise DataError(photographs.name, f"frames of {width}x{height} like the first", found, advice)

    def mask(t: int, c: int) -> np.ndarray:
        valid = photographs.mask(order[t])
        return np.full((height, width), TISSUE) if valid is None else np.where(valid, TISSUE, TOOL)

    seconds = np.arange(len(order)) / DEFAULT_RATE_HZ if times is None else np.asarray(times)[order]
    has_masks, has_depth = photographs.load_mask is not None, photographs.load_depth is not None
    locate = photographs.locate
    return Sequence(
        name=photographs.name,
        camera_ids=(0,),
        width=width,
        height=height,
        times=seconds,
        frame_ids=tuple(range(len(order))),
        Ks=photographs.Ks[order][:, None],
        viewmats=photographs.viewmats[order][:, None],
        load_image=lambda t, c: photographs.image(order[t]),
        load_mask=mask if has_masks else None,
        load_depth=(lambda t, c: photographs.depth(order[t])) if has_depth else None,
        label_names=LABEL_NAMES if has_masks else {},
        near=photographs.near,
        origin=photographs.origin,
        locate=locate and (lambda kind, t, c: locate(kind, order[t])),
        shared_times=True,
        splits=None if photographs.splits is None else tuple(photographs.splits[i] for i in order),
        background=photographs.background,
    )
