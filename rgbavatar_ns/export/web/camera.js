"use strict";
/* A camera that turns about the head; OpenCV axes: x right, y down, z forward. */

class OrbitCamera {
  /** home: rotation (9 numbers, row by row), translation, focal, principal, width, height. */
  constructor(home, centre) {
    this.home = home;
    this.centre = centre;
    this.reset();
  }

  reset() {
    this.yaw = 0;
    this.pitch = 0;
    this.nearness = 1;
    this.shift = [0, 0];
  }

  /** The camera for a picture of this size in pixels; the home picture fits into its middle. */
  at(width, height) {
    const { rotation, translation, focal, principal } = this.home;
    const zoom = Math.min(width / this.home.width, height / this.home.height);
    const turn = multiply3(
      axisAngleToMatrix(this.pitch, 0, 0), axisAngleToMatrix(0, this.yaw, 0));
    const turned = multiply3(rotation, turn);
    const ahead = apply3(rotation, this.centre).map((value, i) => value + translation[i]);
    const moved = apply3(turned, this.centre);
    return {
      rotation: turned,
      // The centre stays where it is in the picture, nearer or farther.
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
    });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      const dx = (event.clientX - last[0]) / canvas.clientHeight;
      const dy = (event.clientY - last[1]) / canvas.clientHeight;
      last = [event.clientX, event.clientY];
      if (event.buttons === 2 || event.shiftKey) {
        this.shift = [this.shift[0] + 0.35 * dx, this.shift[1] + 0.35 * dy];
      } else {
        this.yaw += 3 * dx;
        this.pitch = Math.min(Math.max(this.pitch + 3 * dy, -1.5), 1.5);
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
