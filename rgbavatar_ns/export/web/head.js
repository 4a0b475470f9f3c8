"use strict";
/* The head model: theta to posed vertices and to the tangent frames of its triangles. */

const VERTEX = 4; // numbers a vertex: a texel

const JOINT_FIELDS = ["rotation", "neck", "jaw", "left_eye", "right_eye"];

class Head {
  /** data: theta's layout, the person's neutral head, its offsets. */
  constructor(data) {
    const a = data.arrays, { manifest } = data;
    this.parents = manifest.parents;
    this.variant = manifest.variant;
    this.neutral = a.neutral_vertices;
    this.skinning = a.skinning_weights;
    this.joints = a.joints;
    this.jointDirections = a.joint_directions;
    this.columns = {
      start: a.offset_start, vertex: a.offset_vertex, value: a.offset_value, unit: a.offset_unit,
    };
    this.triangles = a.triangle_vertices;
    this.edgesToFrame = edgesToFrame(a);
    this.restLength = manifest.scale_with_triangle ? a.rest_length : null;
    this.numTriangles = this.triangles.length / 3;
    this.numVertices = this.neutral.length / 3;
    this.movedByJointsOnly = manifest.carrier === "joints";
    this.slices = {};
    this.linear = [];
    let start = 0;
    for (const { name, size, form } of manifest.layout) {
      this.slices[name] = [start, size];
      if (form === "linear") this.linear.push([start, size]);
      start += size;
    }
    this.numExpressions = this.slices.expression[1];
    this.numEyelids = this.slices.eyelids ? this.slices.eyelids[1] : 0;
    this.shaped = new Float32Array(this.neutral.length);
    this.vertices = new Float32Array(VERTEX * 1024 * Math.ceil(this.numVertices / 1024));
  }

  /** Pose the head: fills `turn` and `vertices`. */
  pose(theta) {
    const turns = JOINT_FIELDS.map((name) => {
      const [start] = this.slices[name];
      return axisAngleToMatrix(theta[start], theta[start + 1], theta[start + 2]);
    });
    this.turn = multiply3(turns[0], turns[1]); // of root and neck together, nine numbers
    const moved = this.movedByJointsOnly ? this._withoutLinear(theta) : theta;
    this._shape(moved, turns);
    this._skin(moved, turns);
  }

  /** The middle of the posed head's box, without what the neck does not turn. */
  centre() {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let v = 0; v < this.numVertices; v++) {
      if (this.skinning[5 * v] >= 0.5) continue;
      for (let i = 0; i < 3; i++) {
        low[i] = Math.min(low[i], this.vertices[VERTEX * v + i]);
        high[i] = Math.max(high[i], this.vertices[VERTEX * v + i]);
      }
    }
    return low.map((value, i) => (value + high[i]) / 2);
  }

  /** theta with its expressions and eyelids at rest. */
  _withoutLinear(theta) {
    const moved = theta.slice();
    for (const [start, size] of this.linear) moved.fill(0, start, start + size);
    return moved;
  }

  /** Neutral head plus expressions, eyelids and pose correctives, each a sparse column. */
  _shape(theta, turns) {
    this.shaped.set(this.neutral);
    let column = 0;
    const [expression] = this.slices.expression;
    for (let i = 0; i < this.numExpressions; i++) this._add(column++, theta[expression + i]);
    for (let i = 0; i < this.numEyelids; i++) this._add(column++, theta[this.slices.eyelids[0] + i]);
    if (column === this.columns.start.length - 1) return; // this head has no correctives
    for (let joint = 1; joint < 5; joint++) {
      for (let entry = 0; entry < 9; entry++) {
        this._add(column++, turns[joint][entry] - (entry % 4 === 0 ? 1 : 0));
      }
    }
  }

  _add(column, amount) {
    if (amount === 0) return;
    const { start, vertex, value, unit } = this.columns;
    const factor = amount * unit[column];
    for (let i = start[column]; i < start[column + 1]; i++) {
      const place = 3 * vertex[i];
      this.shaped[place] += factor * value[3 * i];
      this.shaped[place + 1] += factor * value[3 * i + 1];
      this.shaped[place + 2] += factor * value[3 * i + 2];
    }
  }

  /** Linear blend skinning with five joints that expressions may move. */
  _skin(theta, turns) {
    const [expression] = this.slices.expression;
    const joints = Array.from(this.joints);
    for (let i = 0; i < this.numExpressions; i++) {
      const amount = theta[expression + i];
      for (let j = 0; amount !== 0 && j < 15; j++) {
        joints[j] += amount * this.jointDirections[15 * i + j];
      }
    }
    // A bone turns about its joint, and then does what its parent does.
    const rotation = [], shift = [];
    for (let j = 0; j < 5; j++) {
      const at = joints.slice(3 * j, 3 * j + 3);
      const turned = apply3(turns[j], at);
      const local = [at[0] - turned[0], at[1] - turned[1], at[2] - turned[2]];
      const parent = this.parents[j];
      if (parent < 0) {
        rotation.push(turns[j]);
        shift.push(local);
      } else {
        const above = apply3(rotation[parent], local);
        rotation.push(multiply3(rotation[parent], turns[j]));
        shift.push(above.map((value, i) => value + shift[parent][i]));
      }
    }
    const [moved] = this.slices.translation;
    const m = new Float64Array(12);
    for (let v = 0; v < this.numVertices; v++) {
      m.fill(0);
      for (let j = 0; j < 5; j++) {
        const weight = this.skinning[5 * v + j];
        if (weight === 0) continue;
        for (let i = 0; i < 9; i++) m[i] += weight * rotation[j][i];
        for (let i = 0; i < 3; i++) m[9 + i] += weight * shift[j][i];
      }
      const x = this.shaped[3 * v], y = this.shaped[3 * v + 1], z = this.shaped[3 * v + 2];
      for (let i = 0; i < 3; i++) {
        this.vertices[VERTEX * v + i] = m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] * z + m[9 + i]
          + theta[moved + i];
      }
    }
  }

  /**
   * Each triangle's corners and tangent frame as depths: six numbers, of the corners and of a step
   * along T and B (u and v of the texture map) and N (the outward normal).
   */
  frameDepths(camera, depths = null) {
    const p = this.vertices, edges = this.edgesToFrame, { variant } = this;
    const [rx, ry, rz] = camera.rotation.slice(6), shift = camera.translation[2];
    const found = depths ?? new Float32Array(6 * this.numTriangles);
    for (let f = 0; f < this.numTriangles; f++) {
      const a = VERTEX * this.triangles[3 * f];
      const b = VERTEX * this.triangles[3 * f + 1];
      const c = VERTEX * this.triangles[3 * f + 2];
      let ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      let vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      const doubled = Math.sqrt(nx * nx + ny * ny + nz * nz);
      const squares = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz);
      if (!(doubled * doubled > 1e-10 * squares + 1e-30)) {
        // Without area: the world's axes.
        ux = 1; uy = 0; uz = 0; vx = 0; vy = 1; vz = 0; nx = 0; ny = 0; nz = 1;
      } else {
        nx /= doubled; ny /= doubled; nz /= doubled;
      }
      const e0 = edges[4 * f], e1 = edges[4 * f + 1], e2 = edges[4 * f + 2], e3 = edges[4 * f + 3];
      let tx = e0 * ux + e1 * vx, ty = e0 * uy + e1 * vy, tz = e0 * uz + e1 * vz;
      let bx = e2 * ux + e3 * vx, by = e2 * uy + e3 * vy, bz = e2 * uz + e3 * vz;
      if (variant !== "raw") {
        const length = Math.sqrt(tx * tx + ty * ty + tz * tz);
        tx /= length; ty /= length; tz /= length;
      }
      if (variant === "orthonormal") {
        bx = ny * tz - nz * ty; by = nz * tx - nx * tz; bz = nx * ty - ny * tx;
      } else if (variant === "normalized") {
        const length = Math.sqrt(bx * bx + by * by + bz * bz);
        bx /= length; by /= length; bz /= length;
      }
      const place = 6 * f;
      found[place] = rx * p[a] + ry * p[a + 1] + rz * p[a + 2] + shift;
      found[place + 1] = rx * p[b] + ry * p[b + 1] + rz * p[b + 2] + shift;
      found[place + 2] = rx * p[c] + ry * p[c + 1] + rz * p[c + 2] + shift;
      found[place + 3] = rx * tx + ry * ty + rz * tz;
      found[place + 4] = rx * bx + ry * by + rz * bz;
      found[place + 5] = rx * nx + ry * ny + rz * nz;
    }
    return found;
  }
}

/** Each triangle's matrix whose rows give T and B from its two edges; the identity without area. */
function edgesToFrame(arrays) {
  const { triangle_vertices: triangles, triangle_seams: seams, uv } = arrays;
  const found = new Float32Array(4 * triangles.length / 3);
  for (let f = 0; f < triangles.length / 3; f++) {
    // A corner's place in `uv` is its vertex's, or so much farther at a seam of the map.
    const [a, b, c] = [0, 1, 2].map((i) => 2 * (triangles[3 * f + i] + seams[3 * f + i]));
    const u1 = uv[b] - uv[a], v1 = uv[b + 1] - uv[a + 1];
    const u2 = uv[c] - uv[a], v2 = uv[c + 1] - uv[a + 1];
    const determinant = u1 * v2 - u2 * v1;
    const longest = Math.max(u1 * u1, u2 * u2) + Math.max(v1 * v1, v2 * v2);
    const flat = !(Math.abs(determinant) > 1e-6 * longest + 1e-14);
    found.set(flat ? [1, 0, 0, 1] : [v2, -v1, -u2, u1].map((x) => x / determinant), 4 * f);
  }
  const { thin_triangle: thin, thin_edges_to_frame: exact } = arrays;
  thin.forEach((f, i) => found.set(exact.subarray(4 * i, 4 * i + 4), 4 * f));
  return found;
}
