"use strict";
/* A camera that turns about the head; OpenCV axes: x right, y down, z forward. */

const GIVES_WAY = 0.25; // radians that a drag goes on beyond where the avatar holds
const SETTLES_IN = 0.15; // seconds, about

/** An angle that is pulled beyond its ends follows less and less. */
function softly(angle, [low, high]) {
  const over = angle - Math.min(Math.max(angle, low), high);
  return angle - over + GIVES_WAY * Math.tanh(over / GIVES_WAY);
}

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

  /** Let go, the camera comes back to where the avatar holds; whether it is on its way. */
  settle(seconds) {
    if (this.free || this.held) return false;
    const share = 1 - Math.exp(-seconds / SETTLES_IN);
    const over = this.ends().map(([low, high], i) => {
      const angle = this.pulled[i];
      return angle - Math.min(Math.max(angle, low), high);
    });
    const near = over.every((angle) => Math.abs(angle) < 1e-3);
    this.pulled = this.pulled.map((angle, i) => angle - (near ? 1 : share) * over[i]);
    return over.some((angle) => angle !== 0);
  }

  /** Turn by an axis-angle of the home camera's world: [yaw, pitch] as `viewAngles`. */
  static turn([yaw, pitch]) {
    return multiply3(axisAngleToMatrix(-pitch, 0, 0), axisAngleToMatrix(0, -yaw, 0));
  }

  /**
   * The camera for a picture of this size in pixels; the home picture fits into its middle, and
   * the head's centre stays where the home camera sees it, nearer or farther.
   */
  at(width, height, centre) {
    const { rotation, translation, focal, principal } = this.home;
    const zoom = Math.min(width / this.home.width, height / this.home.height);
    const turned = multiply3(rotation, OrbitCamera.turn(this.angles()));
    const ahead = apply3(rotation, centre).map((value, i) => value + translation[i]);
    const moved = apply3(turned, centre);
    return {
      rotation: turned,
      translation: [
        ahead[0] - moved[0] + this.shift[0], ahead[1] - moved[1] + this.shift[1],
        ahead[2] / this.nearness - moved[2],
      ],
      focal: focal.map((value) => value * zoom),
      principal: [
        width / 2 + (principal[0] - this.home.width / 2) * zoom,
        height / 2 + (principal[1] - this.home.height / 2) * zoom,
      ],
      width, height,
    };
  }

  /** Turn by dragging, move with the right button or Shift, zoom with the wheel. */
  listen(canvas, changed) {
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    let last = null; // where the pointer was, in pixels of the window
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      last = [event.clientX, event.clientY];
      this.held = true;
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, () => { last = null; this.held = false; changed(); });
    }
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      const dx = (event.clientX - last[0]) / canvas.clientHeight;
      const dy = (event.clientY - last[1]) / canvas.clientHeight;
      last = [event.clientX, event.clientY];
      if (event.buttons === 2 || event.shiftKey) {
        this.shift = [this.shift[0] + 0.35 * dx, this.shift[1] + 0.35 * dy];
      } else {
        const [yaw, pitch] = this.pulled;
        this.pulled = [yaw - 3 * dx, Math.min(Math.max(pitch - 3 * dy, -1.5), 1.5)];
      }
      changed();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.nearness = Math.min(Math.max(this.nearness * Math.exp(-event.deltaY / 800), 0.2), 4);
      changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.reset(); changed(); });
  }
}
