"use strict";
/* Rotations: matrices are nine numbers row by row, quaternions are real part first. */

/** Rotation matrix of an axis-angle vector in radians (Rodrigues' formula). */
function axisAngleToMatrix(x, y, z) {
  const angle = Math.hypot(x, y, z);
  const alongCross = angle > 1e-8 ? Math.sin(angle) / angle : 1;
  const half = Math.sin(angle / 2);
  const alongOuter = angle > 1e-8 ? (2 * half * half) / (angle * angle) : 0.5;
  const cosine = Math.cos(angle);
  return [
    cosine + alongOuter * x * x, alongOuter * x * y - alongCross * z,
    alongOuter * x * z + alongCross * y,
    alongOuter * x * y + alongCross * z, cosine + alongOuter * y * y,
    alongOuter * y * z - alongCross * x,
    alongOuter * x * z - alongCross * y, alongOuter * y * z + alongCross * x,
    cosine + alongOuter * z * z,
  ];
}

/** Product of two 3 x 3 matrices. */
function multiply3(a, b) {
  const product = new Array(9);
  for (let row = 0; row < 3; row++) {
    for (let column = 0; column < 3; column++) {
      product[3 * row + column] = a[3 * row] * b[column] + a[3 * row + 1] * b[3 + column]
        + a[3 * row + 2] * b[6 + column];
    }
  }
  return product;
}

/** A 3 x 3 matrix times a vector. */
function apply3(m, [x, y, z]) {
  return [
    m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z,
  ];
}

/**
 * How a camera sees a head (its nine numbers from head to camera): yaw and pitch in radians.
 * Positive yaw shows the head's left side, positive pitch looks from below.
 */
function viewAngles(m) {
  return [Math.atan2(-m[6], -m[8]), Math.atan2(m[7], Math.hypot(m[6], m[8]))];
}

/** Write the unit quaternion of the rotation with these columns to `out` at `place`. */
function writeQuaternion(out, place, tx, ty, tz, bx, by, bz, nx, ny, nz) {
  // The largest of the four components is found from the diagonal, the others by division.
  const trace = tx + by + nz;
  let w, x, y, z;
  if (trace > 0) {
    const s = 2 * Math.sqrt(1 + trace);
    w = s / 4; x = (bz - ny) / s; y = (nx - tz) / s; z = (ty - bx) / s;
  } else if (tx > by && tx > nz) {
    const s = 2 * Math.sqrt(1 + tx - by - nz);
    w = (bz - ny) / s; x = s / 4; y = (bx + ty) / s; z = (nx + tz) / s;
  } else if (by > nz) {
    const s = 2 * Math.sqrt(1 + by - tx - nz);
    w = (nx - tz) / s; x = (bx + ty) / s; y = s / 4; z = (ny + bz) / s;
  } else {
    const s = 2 * Math.sqrt(1 + nz - tx - by);
    w = (ty - bx) / s; x = (nx + tz) / s; y = (ny + bz) / s; z = s / 4;
  }
  out[place] = w; out[place + 1] = x; out[place + 2] = y; out[place + 3] = z;
}

/** Axis-angle vector in radians of a rotation matrix, of at most half a turn. */
function matrixToAxisAngle(m) {
  const q = [1, 0, 0, 0];
  writeQuaternion(q, 0, m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]);
  const sine = Math.hypot(q[1], q[2], q[3]);
  const sign = q[0] < 0 ? -1 : 1;
  const factor = sine > 1e-9 ? (sign * 2 * Math.atan2(sine, Math.abs(q[0]))) / sine : 2;
  return [factor * q[1], factor * q[2], factor * q[3]];
}
