"use strict";
/* Which Gaussians are drawn, how large, and in which order. */

const SORT_KEYS = 1 << 16;
const MOST_GROWTH = 2.5;
const FINER = 64; // steps of bases to one of positions, in the order; a Gaussian is off by one at most

/**
 * A level of detail is the first Gaussians of the file, which has the most needed ones first; those
 * of a patch of surface grow by what is missing there, so that it stays closed.
 */
class DetailLevels {
  constructor(data) {
    this.data = data;
    this.growth = new Float32Array(data.manifest.num_gaussians);
    this.count = 0;
  }

  /** Fill `growth` for so many Gaussians; whether it has changed. */
  choose(count) {
    if (count === this.count) return false;
    const { cell, weight, cell_weight: whole } = this.data.arrays;
    const drawn = new Float64Array(whole.length);
    for (let i = 0; i < count; i++) drawn[cell[i]] += weight[i];
    const all = count === this.data.manifest.num_gaussians;
    for (let i = 0; i < count; i++) {
      const missing = all ? 1 : Math.sqrt(whole[cell[i]] / drawn[cell[i]]);
      this.growth[i] = Math.min(Math.max(missing, 1), MOST_GROWTH);
    }
    this.count = count;
    return true;
  }
}

/** Add so many times the values to the sums; on its own, so that it is soon compiled. */
function addTimes(sums, values, times) {
  for (let i = 0; i < sums.length; i++) sums[i] += times * values[i];
}

/** The order from far to near. */
class GaussianOrder {
  constructor(data) {
    const { manifest, arrays: a } = data, count = manifest.num_gaussians;
    this.data = data;
    this.triangleOf = a.triangle_of;
    this.barycentric = a.barycentric;
    this.order = new Uint32Array(1024 * Math.ceil(count / 1024)); // whole rows of texels
    // What the bases add to positions, all x, all y, all z, in steps; whole numbers, so that adding
    // only what changes never drifts.
    this._moved = new Int32Array(3 * count);
    this._times = new Int32Array(3 * manifest.num_bases); // by which each plane of bases is in it
    this._parts = 0; // of the file, of which they are in it
    this._depth = new Float32Array(count);
    this._counts = new Uint32Array(SORT_KEYS + 1);
    this._keys = new Uint16Array(count);
    this._frames = null;
  }

  /** Fill `order` with the first `count` Gaussians, by counting depths in 65,536 bins. */
  sort(head, psi, camera, count) {
    this._blend(psi);
    const [low, high] = this._depths(head, camera, count);
    const depth = this._depth, factor = (SORT_KEYS - 1) / Math.max(high - low, 1e-9);
    const counts = this._counts.fill(0), keys = this._keys;
    for (let i = 0; i < count; i++) {
      keys[i] = (high - depth[i]) * factor;
      counts[keys[i] + 1]++;
    }
    for (let key = 0; key < SORT_KEYS; key++) counts[key + 1] += counts[key];
    for (let i = 0; i < count; i++) this.order[counts[keys[i]]++] = i;
  }

  /** Weigh the bases; those whose weight hardly changes cost nothing. */
  _blend(psi) {
    const { arrays, manifest, spans } = this.data, n = manifest.num_gaussians;
    if (this._parts !== spans.length) {
      this._moved.fill(0);
      this._times.fill(0);
      this._parts = spans.length;
    }
    for (let k = 0; k < manifest.num_bases; k++) {
      for (let axis = 0; axis < 3; axis++) {
        const plane = 3 * k + axis, { unit } = manifest.arrays.basis_position;
        const times = Math.round((psi[k] * unit[plane]) / this._step(axis));
        if (times === this._times[plane]) continue;
        addTimes(this._moved.subarray(axis * n, axis * n + n),
          arrays.basis_position.subarray(plane * n, plane * n + n), times - this._times[plane]);
        this._times[plane] = times;
      }
    }
  }

  _step(axis) {
    return this.data.manifest.arrays.position.unit[axis] / FINER;
  }

  /** Fill `_depth`; its lowest and highest. */
  _depths(head, camera, count) {
    const frames = this._frames = head.frameDepths(camera, this._frames);
    const { triangleOf, barycentric, _moved: moved, _depth: depth } = this, n = depth.length;
    const p = this.data.arrays.position, [dx, dy, dz] = [0, 1, 2].map((axis) => this._step(axis));
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < count; i++) {
      const f = 6 * triangleOf[i], u = barycentric[2 * i], v = barycentric[2 * i + 1];
      const z = u * frames[f] + v * frames[f + 1] + (1 - u - v) * frames[f + 2]
        + (p[i] + dx * moved[i]) * frames[f + 3]
        + (p[n + i] + dy * moved[n + i]) * frames[f + 4]
        + (p[2 * n + i] + dz * moved[2 * n + i]) * frames[f + 5];
      depth[i] = z;
      if (z < low) low = z;
      if (z > high) high = z;
    }
    return [low, high];
  }
}
