"use strict";
/* ARKit's 52 blend shapes and a head's pose as theta, by the table that the avatar brings. */

class ARKitMap {
  /**
   * described: { names, turns: the field that the head's rotation goes into }; table: theta a unit
   * of each, row by row; neutral: the theta that all coefficients of zero mean.
   */
  constructor({ names, turns }, table, fields, neutral) {
    this.names = names;
    this.neutral = neutral;
    this._row = new Map(names.map((name, row) => [name, row]));
    this._table = table;
    this._fields = fields;
    this._turns = turns;
    this._warned = new Set();
  }

  /**
   * Theta of coefficients by name, held to 0..1, and a pose { rotation, translation }, each of
   * which may be missing. Unknown names are told once, NaN counts as missing. Throws TypeError or
   * RangeError for what is no coefficient or no pose.
   */
  theta(coefficients, pose) {
    if (typeof coefficients !== "object" || coefficients === null || Array.isArray(coefficients)) {
      throw new TypeError(`The coefficients are ${inWords(coefficients)}; expected { jawOpen: 0.4, ... }.`);
    }
    const theta = this.neutral.slice(), size = theta.length;
    for (const [name, value] of Object.entries(coefficients)) {
      if (typeof value !== "number") {
        throw new TypeError(`${name.slice(0, 30)} is ${inWords(value)}; expected a number.`);
      }
      const row = this._rowOf(name);
      if (row === undefined || Number.isNaN(value)) continue;
      const amount = clamp(value, [0, 1]);
      for (let i = 0; amount > 0 && i < size; i++) theta[i] += amount * this._table[row * size + i];
    }
    if (pose !== undefined && pose !== null) this._pose(theta, pose);
    return theta;
  }

  /** The place of a name, which some programs begin with a capital letter. */
  _rowOf(name) {
    const row = this._row.get(name.charAt(0).toLowerCase() + name.slice(1));
    if (row === undefined && !this._warned.has(name) && this._warned.size < MOST_WARNINGS) {
      this._warned.add(name);
      console.warn(`rgbavatar: ARKit has no blend shape "${name.slice(0, 30)}"; it is ignored.`);
    }
    return row;
  }

  /** The head's turn takes the place of the neutral one; the whole avatar moves. */
  _pose(theta, pose) {
    if (typeof pose !== "object") {
      throw new TypeError(`The pose is ${inWords(pose)}; expected { rotation, translation }.`);
    }
    const { rotation = null, translation = null } = pose, start = this._fields.start;
    if (rotation !== null) {
      readNumbers(rotation, 3, "pose.rotation").forEach((value, i) => {
        theta[start[this._turns] + i] = value;
      });
    }
    if (translation !== null) {
      readNumbers(translation, 3, "pose.translation").forEach((value, i) => {
        theta[start.translation + i] += value;
      });
    }
  }
}

const MOST_WARNINGS = 20; // of a stranger's names, so that none fills the memory

/**
 * The pose that a rigid 4 x 4 matrix (sixteen numbers, column by column) stands for, from a camera
 * with x right, y up, z backward: MediaPipe's facialTransformationMatrixes, in centimetres.
 */
function poseOfMatrix(matrix, metresPerUnit = 0.01) {
  const m = readNumbers(matrix, 16, "matrix");
  const size = Math.cbrt(Math.abs(m[0] * (m[5] * m[10] - m[6] * m[9])
    - m[4] * (m[1] * m[10] - m[2] * m[9]) + m[8] * (m[1] * m[6] - m[2] * m[5])));
  if (!(size > 0)) throw new RangeError("The matrix has no rotation: its determinant is zero.");
  const turn = [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]];
  return {
    rotation: matrixToAxisAngle(turn.map((value) => value / size)),
    translation: [m[12], m[13], m[14]].map((value) => value * metresPerUnit),
  };
}
