"use strict";
/* Where the Gaussians are: blended positions in the world, and their order from far to near. */

const SORT_KEYS = 1 << 16;

/** Add so many times the values to the sums; on its own, so that it is soon compiled. */
function addScaled(sums, values, factor) {
  if (factor === 0) return;
  for (let i = 0; i < sums.length; i++) sums[i] += factor * values[i];
}

class GaussianPositions {
  constructor(data) {
    const a = data.arrays;
    this.count = data.num_gaussians;
    this.numBases = data.num_bases;
    // Coordinates lie in planes: all x, all y, all z; bases are small whole numbers times a unit.
    this.base = a.position;
    this.bases = a.basis_position;
    this.units = a.basis_position_unit;
    this.blended = new Float32Array(3 * this.count);
    this.triangleOf = a.triangle_of;
    this.barycentric = a.barycentric;
    this.rows = Math.ceil(this.count / 1024);
    // x, y, z and the triangle's growth, as the renderer's texture wants them.
    this.world = new Float32Array(4 * 1024 * this.rows);
    this.depth = new Float32Array(this.count);
    this.order = new Uint32Array(1024 * this.rows); // filled up to whole rows of texels
    this._counts = new Uint32Array(SORT_KEYS + 1);
    this._keys = new Uint16Array(this.count);
  }

  /** Base plus weighted bases, in each Gaussian's tangent frame. */
  blend(psi) {
    this.blended.set(this.base);
    const n = this.count;
    for (let k = 0; k < this.numBases; k++) {
      for (let axis = 0; axis < 3; axis++) {
        const from = (3 * k + axis) * n;
        const plane = this.blended.subarray(axis * n, axis * n + n);
        addScaled(plane, this.bases.subarray(from, from + n), psi[k] * this.units[3 * k + axis]);
      }
    }
  }

  /** Tangent frames of a posed head carry the blended positions into the world. */
  place(head) {
    const n = this.count, p = this.blended, { vertices, triangles, frames, lengthRatio } = head;
    for (let i = 0; i < n; i++) {
      const f = this.triangleOf[i];
      const a = 3 * triangles[3 * f], b = 3 * triangles[3 * f + 1], c = 3 * triangles[3 * f + 2];
      const u = this.barycentric[3 * i], v = this.barycentric[3 * i + 1];
      const w = this.barycentric[3 * i + 2];
      const x = p[i], y = p[n + i], z = p[2 * n + i];
      for (let axis = 0; axis < 3; axis++) {
        this.world[4 * i + axis] = u * vertices[a + axis] + v * vertices[b + axis]
          + w * vertices[c + axis] + frames[9 * f + axis] * x + frames[9 * f + 3 + axis] * y
          + frames[9 * f + 6 + axis] * z;
      }
      this.world[4 * i + 3] = lengthRatio[f];
    }
  }

  /** Fill `order` with the Gaussians from far to near, by counting depths in 65,536 bins. */
  sort(camera) {
    const [r0, r1, r2] = camera.rotation.slice(6), shift = camera.translation[2];
    const n = this.count, world = this.world, depth = this.depth;
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < n; i++) {
      const z = r0 * world[4 * i] + r1 * world[4 * i + 1] + r2 * world[4 * i + 2] + shift;
      depth[i] = z;
      if (z < low) low = z;
      if (z > high) high = z;
    }
    const factor = (SORT_KEYS - 1) / Math.max(high - low, 1e-9);
    const counts = this._counts.fill(0), keys = this._keys;
    for (let i = 0; i < n; i++) {
      keys[i] = (high - depth[i]) * factor;
      counts[keys[i] + 1]++;
    }
    for (let key = 0; key < SORT_KEYS; key++) counts[key + 1] += counts[key];
    for (let i = 0; i < n; i++) this.order[counts[keys[i]]++] = i;
  }
}
