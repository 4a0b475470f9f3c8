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

/** Axis-angle vector in radians of a rotation matrix, of at most half a turn. */
function matrixToAxisAngle(m) {
  const sines = [(m[7] - m[5]) / 2, (m[2] - m[6]) / 2, (m[3] - m[1]) / 2]; // the axis, that long
  const sine = Math.hypot(...sines), cosine = (m[0] + m[4] + m[8] - 1) / 2;
  const angle = Math.atan2(sine, cosine);
  if (sine > 1e-6) return sines.map((value) => (value * angle) / sine);
  if (cosine > 0) return sines;
  // Half a turn: the matrix is twice the axis's outer product less the identity.
  const i = [m[0], m[4], m[8]].reduce((most, value, k, all) => (value > all[most] ? k : most), 0);
  const length = Math.sqrt((m[4 * i] + 1) / 2);
  return [0, 1, 2].map((k) => angle * (k === i ? length : (m[3 * i + k] + m[3 * k + i]) / (4 * length)));
}
