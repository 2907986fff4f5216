"""Shaped array types. Shapes are enforced while the tests run (jaxtyping with beartype), and are documentation otherwise."""

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8, UInt16

Vec2 = Float[np.ndarray, "2"]
Vec3 = Float[np.ndarray, "3"]
Mat3 = Float[np.ndarray, "3 3"]
Mat4 = Float[np.ndarray, "4 4"]
Points2 = Float[np.ndarray, "_ 2"]
Points3 = Float[np.ndarray, "_ 3"]
AnyPoints3 = Float[np.ndarray, "*batch 3"]
LegJoints = Float[np.ndarray, "dof"]
LegPath = Float[np.ndarray, "_ dof"]
Joints = Float[np.ndarray, "6 dof"]
Wheels = Float[np.ndarray, "6 3"]
PerLeg = Float[np.ndarray, "6"]
PerLegFlag = Bool[np.ndarray, "6"]
Image = UInt8[np.ndarray, "h w"]
RawImage = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
DepthMap = Float[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Cells = Float[np.ndarray, "nx ny"]
CellFlags = Bool[np.ndarray, "nx ny"]
CellCounts = Integer[np.ndarray, "nx ny"]
