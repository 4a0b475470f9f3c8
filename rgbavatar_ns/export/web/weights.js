"use strict";
/* The weight network: theta to the weights psi of the learned bases. */

class WeightNetwork {
  constructor(data) {
    const { manifest } = data;
    this.layout = manifest.layout;
    this.numBases = manifest.num_bases;
    this.withPose = manifest.pose_input;
    this.withTranslation = manifest.translation_input;
    this.low = data.arrays.theta_low; // of the film; above `high` where nothing is known
    this.high = data.arrays.theta_high;
    this.layers = manifest.network.map(({ inputs, outputs }, i) => ({
      inputs, outputs,
      matrix: data.arrays[`network_matrix_${i}`], bias: data.arrays[`network_bias_${i}`],
    }));
  }

  /** Theta as it is within the film's range; beyond, each number by itself goes ever less far. */
  within(theta) {
    return Array.from(theta, (value, i) => {
      const [low, high] = [this.low[i], this.high[i]];
      if (low > high) return value;
      const room = high - low + 0.05, nearest = Math.min(Math.max(value, low), high);
      return nearest + room * Math.tanh((value - nearest) / room);
    });
  }

  /** Linear fields as they are, rotations as the first two rows of their matrix. */
  features(theta) {
    const found = [];
    let start = 0;
    for (const { size, form } of this.layout) {
      const part = theta.slice(start, start + size);
      if (form === "linear" || (form === "translation" && this.withTranslation)) {
        found.push(...part);
      } else if (form === "axis_angle" && this.withPose) {
        found.push(...axisAngleToMatrix(...part).slice(0, 6));
      }
      start += size;
    }
    return found;
  }

  expressions(theta) {
    let start = 0;
    for (const { name, size } of this.layout) {
      if (name === "expression") return theta.slice(start, start + size);
      start += size;
    }
    return [];
  }

  /** psi, a plain array with a number for each basis. */
  evaluate(wanted) {
    const theta = this.within(wanted);
    // Without a network the first expression coefficients are the weights.
    if (!this.layers.length) return this.expressions(theta).slice(0, this.numBases);
    let values = this.features(theta);
    this.layers.forEach(({ inputs, outputs, matrix, bias }, layer) => {
      const next = new Array(outputs);
      for (let row = 0; row < outputs; row++) {
        let sum = bias[row];
        for (let column = 0; column < inputs; column++) {
          sum += matrix[row * inputs + column] * values[column];
        }
        next[row] = layer < this.layers.length - 1 ? Math.max(sum, 0) : sum;
      }
      values = next;
    });
    return values;
  }
}
