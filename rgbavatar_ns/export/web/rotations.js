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
