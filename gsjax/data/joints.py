"""How a part can move against what it is fixed to."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.data.validation import check_shape


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint whose axis stands still, and how far it was open over time.

    Attributes:
        kind: "prismatic" (slides along the axis) or "revolute" (turns about it, right-handed).
        axis: direction in the world, of length 1, [3].
        point: on the axis, metres, world, [3].
        values: metres or radians, [T].

    Raises:
        ValueError: shapes or the kind are wrong, or the axis is not of length 1.
    """

    kind: str
    axis: Float[np.ndarray, "..."]
    point: Float[np.ndarray, "..."]
    values: Float[np.ndarray, "..."]

    def __post_init__(self):
        check_shape("axis", self.axis, (3,))
        check_shape("point", self.point, (3,))
        check_shape("values", self.values, (np.size(self.values),))
        if self.kind not in ("prismatic", "revolute"):
            raise ValueError(f"kind: expected prismatic or revolute, found {self.kind!r}")
        length = float(np.linalg.norm(self.axis))
        if not abs(length - 1) < 1e-4:
            raise ValueError(f"axis: expected a direction of length 1, found length {length:.4g}")

    def motions(self) -> Float[np.ndarray, "frames 4 4"]:
        """The rigid motions of the world that take a part from value 0 to where it was."""
        motions = np.broadcast_to(np.eye(4), (len(self.values), 4, 4)).copy()
        along = self.values[:, None] * self.axis
        if self.kind == "prismatic":
            motions[:, :3, 3] = along
        else:
            motions[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
            motions[:, :3, 3] = self.point - motions[:, :3, :3] @ self.point
        return motions
