"""Where hair grows: on crown and back, and not on faces, ears or necks."""

import numpy as np
import pytest

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD
from rgbavatar_ns.head.hair import haired_vertices


@pytest.mark.parametrize("name", [EMBEDDED_HEAD, EMBEDDED_BUST])
def test_crown_and_back_have_hair_and_face_ears_and_neck_have_none(name: str):
    arrays = HeadArrays.embedded(name)
    x, y, z = arrays.v_template.T
    haired = haired_vertices(arrays)
    crown = y > y.max() - 0.02
    back = (z < z[y > 0].min() + 0.02) & (y > 0.02)
    face = (z > 0.05) & (y < 0.05)
    ears = (y > -0.06) & (np.abs(x) > 0.075)
    neck = (y < -0.1) & (z < 0)
    assert min(part.sum() for part in (crown, back, face, ears, neck)) > 5
    assert haired[crown | back].all()
    assert not haired[face | ears | neck].any()
