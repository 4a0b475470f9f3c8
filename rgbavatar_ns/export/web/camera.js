"use strict";
/* Cameras in the head's world; OpenCV axes: x right, y down, z forward. */

const GIVES_WAY = 0.25; // radians that a drag goes on beyond where the avatar holds
const SETTLES_IN = 0.15; // seconds, about
const STEEPEST = 1.5; // radians up or down, short of the poles
const NEARNESS = [0.2, 4]; // times the home camera's
const TURN_BY_DRAG = 3; // radians over the canvas's height
const CLOSER_ON_TALL = 1.4; // a phone shows less of the shoulders and more of the face
const SHIFT_BY_DRAG = 0.35; // metres over the canvas's height

const clamp = (value, [low, high]) => Math.min(Math.max(value, low), high);

/** An angle that is pulled beyond its ends follows less and less. */
function softly(angle, ends) {
  const over = angle - clamp(angle, ends);
  return angle - over + GIVES_WAY * Math.tanh(over / GIVES_WAY);
}

/**
 * The camera of a view and a projection matrix as OpenGL has them (x right, y up, z backward;
 * sixteen numbers column by column, as three.js's `elements`), for a picture of this size.
 */
function openGLCamera(view, projection, width, height) {
  const v = readNumbers(view, 16, "view"), p = readNumbers(projection, 16, "projection");
  return {
    rotation: [v[0], v[4], v[8], -v[1], -v[5], -v[9], -v[2], -v[6], -v[10]],
    translation: [v[12], -v[13], -v[14]],
    focal: [(p[0] * width) / 2, (p[5] * height) / 2],
    principal: [(width / 2) * (1 - p[8]), (height / 2) * (1 + p[9])],
    width, height,
  };
}

/** A camera of somebody else's, checked; throws TypeError or RangeError. */
function readCamera(camera) {
  if (typeof camera !== "object" || camera === null) {
    throw new TypeError(`The camera is ${inWords(camera)}; expected an object.`);
  }
  const read = (name, size) => readNumbers(camera[name], size, `camera.${name}`);
  const rotation = read("rotation", 9);
  for (const [i, j] of [[0, 0], [1, 1], [2, 2], [0, 1], [0, 2], [1, 2]]) {
    const product = [0, 1, 2].reduce((sum, k) => sum + rotation[3 * i + k] * rotation[3 * j + k], 0);
    if (Math.abs(product - (i === j ? 1 : 0)) > 1e-3) {
      throw new RangeError("camera.rotation is no rotation matrix: its rows are not orthonormal.");
    }
  }
  const [width, height] = readNumbers([camera.width, camera.height], 2, "camera's width and height");
  const focal = read("focal", 2);
  if (!(width > 0 && height > 0 && focal[0] > 0 && focal[1] > 0)) {
    throw new RangeError("camera.width, height and focal are to be above zero.");
  }
  const [translation, principal] = [read("translation", 3), read("principal", 2)];
  return { rotation, translation, focal, principal, width, height };
}

/** The same camera for a picture of another size, which it fills. */
function resizedCamera(camera, width, height) {
  const zoom = [width / camera.width, height / camera.height];
  return {
    ...camera, width, height,
    focal: camera.focal.map((value, i) => value * zoom[i]),
    principal: camera.principal.map((value, i) => value * zoom[i]),
  };
}

/** A camera that turns about the head. */
class OrbitCamera {
  /**
   * home: rotation (9 numbers, row by row), translation, focal, principal, width, height.
   * reach: lowest and highest [yaw, pitch] in radians from where the avatar holds, as `viewAngles`.
   */
  constructor(home, reach) {
    this.home = home;
    this.reach = reach;
    this.free = false; // turn without an end
    this.held = false; // by a pointer
    this.seen = [0, 0]; // how the home camera sees the head, as `viewAngles`
    this.reset();
  }

  reset() {
    this.pulled = [0, 0]; // yaw and pitch from the home camera, without any end
    this.nearness = 1;
    this.shift = [0, 0];
  }

  /** How far yaw and pitch may turn from the home camera; zero is always within. */
  ends() {
    const [low, high] = this.reach;
    return this.seen.map((angle, i) => [Math.min(low[i] - angle, 0), Math.max(high[i] - angle, 0)]);
  }

  /** Yaw and pitch from the home camera. */
  angles() {
    return this.free ? this.pulled : this.ends().map((ends, i) => softly(this.pulled[i], ends));
  }

  /** Turn to these angles from the home camera, no farther than the avatar holds. */
  turnTo(yaw, pitch) {
    const wanted = [yaw, clamp(pitch, [-STEEPEST, STEEPEST])];
    this.pulled = this.free ? wanted : this.ends().map((ends, i) => clamp(wanted[i], ends));
  }

  /** Pull on by these angles; what goes too far gives way. */
  pull(yaw, pitch) {
    this.pulled = [this.pulled[0] + yaw, clamp(this.pulled[1] + pitch, [-STEEPEST, STEEPEST])];
  }

  /** Come nearer by a factor. */
  zoom(factor) {
    this.nearness = clamp(this.nearness * factor, NEARNESS);
  }

  /** Let go, the camera comes back to where the avatar holds; whether it is on its way. */
  settle(seconds) {
    if (this.free || this.held) return false;
    const share = 1 - Math.exp(-seconds / SETTLES_IN);
    const over = this.ends().map((ends, i) => this.pulled[i] - clamp(this.pulled[i], ends));
    const near = over.every((angle) => Math.abs(angle) < 1e-3);
    this.pulled = this.pulled.map((angle, i) => angle - (near ? 1 : share) * over[i]);
    return over.some((angle) => angle !== 0);
  }

  /** Turn by an axis-angle of the home camera's world: [yaw, pitch] as `viewAngles`. */
  static turn([yaw, pitch]) {
    return multiply3(axisAngleToMatrix(-pitch, 0, 0), axisAngleToMatrix(0, -yaw, 0));
  }

  /**
   * The camera for a picture of this size in pixels; the home picture fits into its middle, or its
   * sides are cut where that leaves much room above and below. The head's centre stays where the
   * home camera sees it, nearer or farther.
   */
  at(width, height, centre) {
    const { rotation, translation, focal, principal } = this.home;
    const turned = multiply3(rotation, OrbitCamera.turn(this.angles()));
    const ahead = apply3(rotation, centre).map((value, i) => value + translation[i]);
    const moved = apply3(turned, centre);
    const { zoom, middle } = this._cut(width, height, (focal[0] * ahead[0]) / ahead[2] + principal[0]);
    return {
      rotation: turned,
      translation: [
        ahead[0] / this.nearness - moved[0] + this.shift[0],
        ahead[1] / this.nearness - moved[1] + this.shift[1],
        ahead[2] / this.nearness - moved[2],
      ],
      focal: focal.map((value) => value * zoom),
      principal: [
        width / 2 + (principal[0] - middle) * zoom,
        height / 2 + (principal[1] - this.home.height / 2) * zoom,
      ],
      width, height,
    };
  }

  /** How much larger the home picture is shown, and which of its columns is in the middle. */
  _cut(width, height, headColumn) {
    const across = width / this.home.width, down = height / this.home.height;
    const zoom = Math.min(down, across * CLOSER_ON_TALL);
    if (zoom <= across) return { zoom, middle: this.home.width / 2 };
    this._column ??= headColumn; // the first one's, so that a head that moves is seen to move
    const half = this.home.width * (across / zoom) / 2;
    return { zoom, middle: clamp(this._column, [half, this.home.width - half]) };
  }

  /**
   * One pointer turns; with Shift, the right button or a second finger it moves; two fingers and
   * the wheel zoom, a double click brings the camera back. Until the signal aborts.
   */
  listen(canvas, changed, signal) {
    const on = (name, act, options = {}) => canvas.addEventListener(name, act, { ...options, signal });
    const pointers = new Map(); // where each is, in pixels of the window
    on("contextmenu", (event) => event.preventDefault());
    on("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this.held = true;
    });
    for (const end of ["pointerup", "pointercancel"]) {
      on(end, (event) => {
        pointers.delete(event.pointerId);
        this.held = pointers.size > 0;
        changed();
      });
    }
    on("pointermove", (event) => {
      if (!pointers.has(event.pointerId) || pointers.size > 2) return;
      const before = grip([...pointers.values()]);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const after = grip([...pointers.values()]);
      const moved = before.middle.map((at, i) => (after.middle[i] - at) / canvas.clientHeight);
      if (pointers.size === 2 || event.buttons === 2 || event.shiftKey) {
        this.shift = this.shift.map((at, i) => at + SHIFT_BY_DRAG * moved[i]);
        if (before.spread > 0 && after.spread > 0) this.zoom(after.spread / before.spread);
      } else {
        this.pull(-TURN_BY_DRAG * moved[0], -TURN_BY_DRAG * moved[1]);
      }
      changed();
    });
    on("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 800));
      changed();
    }, { passive: false });
    on("dblclick", () => { this.reset(); changed(); });
  }
}

/** The middle of one or two points, and how far apart they are. */
function grip(points) {
  const [a, b] = [points[0], points[points.length - 1]];
  return {
    middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], spread: Math.hypot(a[0] - b[0], a[1] - b[1]),
  };
}
