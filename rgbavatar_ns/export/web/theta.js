"use strict";
/* What may be a theta, told in words where it is none. */

/** No person does more, as in the project's ThetaLayout.absurd: a weight, two turns, metres. */
const LARGEST = { linear: 100, axis_angle: 4 * Math.PI, translation: 100 };

/** A plain array of so many finite numbers; TypeError and RangeError say what was expected. */
function readNumbers(values, size, name) {
  const listed = Array.isArray(values) || (ArrayBuffer.isView(values) && "length" in values);
  if (!listed) throw new TypeError(`${name} is ${inWords(values)}; expected ${size} numbers.`);
  if (values.length !== size) {
    throw new RangeError(`${name} has ${values.length} numbers; expected ${size}.`);
  }
  return Array.from(values, (value, i) => {
    if (typeof value !== "number") {
      throw new TypeError(`${name}[${i}] is ${inWords(value)}; expected a number.`);
    }
    if (!Number.isFinite(value)) {
      throw new RangeError(`${name}[${i}] is ${value}; expected a finite number.`);
    }
    return value;
  });
}

/** A value of somebody else's in a few words. */
function inWords(value) {
  if (value === null || value === undefined) return String(value);
  if (typeof value === "string") return `the text "${value.slice(0, 30)}"`;
  return typeof value === "number" ? String(value) : `of type ${typeof value}`;
}

class ThetaFields {
  /** layout: a list of { name, size, form } in theta's order. */
  constructor(layout) {
    this.layout = layout;
    this.start = {};
    this.size = 0;
    for (const { name, size } of layout) {
      this.start[name] = this.size;
      this.size += size;
    }
  }

  /** Theta as a plain array; throws as `readNumbers`, and for what no person can do. */
  read(values) {
    const theta = readNumbers(values, this.size, "theta");
    for (const { name, size, form } of this.layout) {
      for (let i = this.start[name]; i < this.start[name] + size; i++) {
        if (Math.abs(theta[i]) > LARGEST[form]) {
          throw new RangeError(`theta[${i}] (${name}) is ${theta[i]}; expected at most `
            + `${LARGEST[form].toPrecision(4)} either way.`);
        }
      }
    }
    return theta;
  }

  /** Whether another layout has the same fields in the same order. */
  equals(other) {
    return Array.isArray(other) && other.length === this.layout.length
      && this.layout.every(({ name, size, form }, i) => other[i] !== null
        && other[i]?.name === name && other[i]?.size === size && other[i]?.form === form);
  }
}
