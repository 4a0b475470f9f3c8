"use strict";
/* What both renderers share: which Gaussians, in which order, with which weights and numbers. */

const TEXTURE_WIDTH = 1024; // Gaussians, vertices and triangles lie in rows of so many
const VARIANTS = ["normalized", "raw", "orthonormal"];
const LEAST_MOVING = 6000; // Gaussians; with fewer a face loses its eyes
const WHOLE = { detail: 1, resolution: 1, bytes: false };

/** Four numbers of each Gaussian, by the arrays that they are columns of. */
const BASE_TABLES = {
  scaleOpacity: [["scale", 3], ["opacity", 1]],
  baseRotation: [["rotation", 4]],
  baseColor: [["color", 3], ["triangle_of", 1]],
  basePosition: [["position", 3]],
};
/** The bases' arrays and columns, in the order of their weights. */
const BASIS_TABLES = {
  basisRotation: ["basis_rotation", 4],
  basisColor: ["basis_color", 3],
  basisPosition: ["basis_position", 3],
};

class GaussianRenderer {
  constructor(data) {
    this.data = data;
    this.detail = 1; // share of the Gaussians that is drawn, in (0, 1]
    this.total = data.manifest.num_gaussians;
    this.numBases = data.manifest.num_bases;
    this.rows = Math.ceil(this.total / TEXTURE_WIDTH);
    this.order = new GaussianOrder(data);
    this.levels = new DetailLevels(data);
    this.weightValues = new Float32Array(12 * Math.max(this.numBases, 1));
    this.filledParts = 0; // of the file, so many are in the graphics memory
  }

  /** How many Gaussians are drawn for a share of `detail`; no more than have arrived. */
  count({ detail }) {
    const whole = Math.ceil(this.detail * this.total);
    const moving = Math.max(Math.ceil(detail * whole), Math.min(whole, LEAST_MOVING));
    return Math.min(moving, this.data.available);
  }

  /** Corners' numbers for two triangles a Gaussian; instances of four corners are slow to start. */
  _boxCorners() {
    const corners = new Uint32Array(6 * this.total);
    for (let i = 0; i < this.total; i++) {
      corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    }
    return corners;
  }

  /**
   * Of each triangle, in whole rows: corners, three vertices' numbers and the length at rest or 0
   * (a float's bits); edges, the matrix from its edges to its frame.
   */
  _faces() {
    const { arrays: a, manifest } = this.data, faces = a.triangle_vertices.length / 3;
    const rows = Math.ceil(faces / TEXTURE_WIDTH);
    const corners = new Uint32Array(4 * TEXTURE_WIDTH * rows);
    const lengths = new Float32Array(corners.buffer);
    for (let f = 0; f < faces; f++) {
      for (let i = 0; i < 3; i++) corners[4 * f + i] = a.triangle_vertices[3 * f + i];
      if (manifest.scale_with_triangle) lengths[4 * f + 3] = a.rest_length[f];
    }
    const edges = new Float32Array(corners.length);
    edges.set(edgesToFrame(a));
    return { rows, corners, edges };
  }

  /** Bring to the graphics memory what has arrived since. */
  _fill() {
    const { spans } = this.data;
    for (; this.filledParts < spans.length; this.filledParts++) {
      const [from, to] = spans[this.filledParts];
      if (to > from) this._fillRows(Math.floor(from / TEXTURE_WIDTH), Math.ceil(to / TEXTURE_WIDTH));
    }
  }

  _fillRows(top, bottom) {
    const { manifest, arrays } = this.data, first = TEXTURE_WIDTH * top;
    const texels = TEXTURE_WIDTH * (bottom - top), last = Math.min(first + texels, this.total);
    /** Put columns of an array side by side into texels, from number `at` of each on. */
    const fill = (texelValues, at, name, column, columns) => {
      const source = arrays[name], described = manifest.arrays[name];
      const [item, next] = described.by_item ? [described.columns, 1] : [1, described.items];
      for (let c = 0; c < columns; c++) {
        const place = (column + c) * next;
        for (let i = first; i < last; i++) {
          texelValues[4 * (i - first) + at + c] = source[place + i * item];
        }
      }
    };
    for (const [table, parts] of Object.entries(BASE_TABLES)) {
      const values = new Float32Array(4 * texels);
      let at = 0;
      for (const [name, columns] of parts) {
        fill(values, at, name, 0, columns);
        at += columns;
      }
      this._putBase(table, values, top);
    }
    for (const [table, [name, columns]] of Object.entries(BASIS_TABLES)) {
      const bytes = new Int8Array(4 * texels);
      for (let k = 0; k < this.numBases; k++) {
        fill(bytes, 0, name, columns * k, columns);
        this._putBasis(table, k, bytes, top);
      }
    }
    this.levels.count = 0; // their anchors, too, are to be filled
  }

  /** Barycentric coordinates and growth of the Gaussians that are drawn. */
  _fillAnchors(count) {
    if (!this.levels.choose(count)) return;
    const { barycentric } = this.data.arrays;
    const values = new Float32Array(4 * TEXTURE_WIDTH * Math.ceil(count / TEXTURE_WIDTH));
    for (let i = 0; i < count; i++) {
      values[4 * i] = barycentric[2 * i];
      values[4 * i + 1] = barycentric[2 * i + 1];
      values[4 * i + 2] = this.levels.growth[i];
    }
    this._putBase("anchor", values, 0);
  }

  /** The first `count` of the order, in whole rows. */
  _sorted(head, psi, camera, count) {
    this.order.sort(head, psi, camera, count);
    return this.order.order.subarray(0, TEXTURE_WIDTH * Math.ceil(count / TEXTURE_WIDTH));
  }

  /** The camera of the picture, which may have fewer pixels than the canvas. */
  _reduced({ rotation, translation, focal, principal, width, height }, resolution) {
    const size = [width, height].map((side) => Math.max(1, Math.round(resolution * side)));
    const [x, y] = [size[0] / width, size[1] / height];
    return {
      rotation, translation, width: size[0], height: size[1],
      focal: [focal[0] * x, focal[1] * y], principal: [principal[0] * x, principal[1] * y],
    };
  }

  /** Lowest and highest slopes x / z and y / z where the projection is linearised. */
  _slopes({ focal, principal, width, height }) {
    // The projection is linearised no further outside the image than this.
    const size = [width, height];
    const margin = size.map((length, i) => (0.3 * 0.5 * length) / focal[i]);
    return {
      low: principal.map((centre, i) => -centre / focal[i] - margin[i]),
      high: principal.map((centre, i) => (size[i] - centre) / focal[i] + margin[i]),
    };
  }

  /** psi times the units of rotation, colour and position; a byte of 127 is read as 1. */
  _weigh(psi) {
    const { arrays } = this.data.manifest, row = 4 * Math.max(this.numBases, 1);
    Object.values(BASIS_TABLES).forEach(([name, columns], place) => {
      for (let k = 0; k < this.numBases; k++) {
        const { unit } = arrays[name];
        for (let i = 0; i < columns; i++) {
          this.weightValues[place * row + 4 * k + i] = 127 * psi[k] * unit[columns * k + i];
        }
      }
    });
    return this.weightValues;
  }
}
