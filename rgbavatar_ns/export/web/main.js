"use strict";
/* Glue: state of the page, one picture for each change, `window.rgbavatar` for scripts. */

class App {
  constructor(data, canvas, message) {
    const { manifest } = data;
    this.data = manifest;
    this.canvas = canvas;
    this.message = message;
    this.head = new Head(data);
    this.network = new WeightNetwork(data);
    this.renderer = new Renderer(canvas, data);
    this.pace = new Pace();
    this.performance = new RecordedPerformance(data);
    this.orbit = new OrbitCamera(manifest.camera, manifest.film.turn_reach);
    this.background = manifest.background;
    this.heldWeights = new Map(); // psi that a slider holds, by number
    this.beyond = document.getElementById("beyond");
    this.size = null; // of the picture in pixels, where a script has set it
    this.theta = this.performance.length ? this.performance.current()
      : new Array(this.performance.size).fill(0);
    this.psi = [];
    this.pictures = 0; // drawn so far
    this.due = true;
    this.panel = new Panel(document.getElementById("panel"), this);
    this.orbit.listen(canvas, () => this.changed());
    new ResizeObserver(() => this.changed()).observe(canvas);
    this.touched = false; // whether the theta shown is somebody's choice
    data.onMore = () => {
      if (!this.touched && this.performance.length) this.theta = this.performance.current();
      this.changed();
    };
    this._last = null;
    requestAnimationFrame((now) => this._tick(now));
  }

  /** Have a new picture drawn. */
  changed() {
    this.due = true;
  }

  play(on) {
    this.touched = true;
    this.performance.playing = on;
    if (on) this.showFrame(this.performance.place);
  }

  showFrame(place) {
    this.touched = true;
    this.performance.place = place;
    this.theta = this.performance.current();
  }

  /** Set one number of theta by hand, which stops the performance. */
  setParameter(place, value) {
    this.touched = true;
    this.performance.playing = false;
    this.theta[place] = value;
    this.changed();
  }

  setTheta(theta) {
    this.touched = true;
    this.performance.playing = false;
    this.theta = Array.from(theta);
    this.changed();
  }

  /** Hold a basis weight against the network. */
  setWeight(k, value) {
    this.heldWeights.set(k, value);
    this.changed();
  }

  releaseWeights() {
    this.heldWeights.clear();
    this.changed();
  }

  /** Fix the picture's size in pixels, whatever the window's. */
  setSize(width, height) {
    this.size = [width, height];
    this.changed();
  }

  /** Draw now; share: how much, where not all (`Pace`). */
  draw(share) {
    const pixels = window.devicePixelRatio || 1;
    const [width, height] = this.size || [
      Math.max(1, Math.round(this.canvas.clientWidth * pixels)),
      Math.max(1, Math.round(this.canvas.clientHeight * pixels)),
    ];
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    this.psi = this.network.evaluate(this.theta);
    for (const [k, value] of this.heldWeights) this.psi[k] = value;
    this.head.pose(this.theta);
    this.orbit.seen = viewAngles(multiply3(this.data.camera.rotation, this.head.turn));
    const camera = this.orbit.at(width, height, this.head.centre());
    this.turnSeen = viewAngles(multiply3(camera.rotation, this.head.turn));
    this.renderer.draw(this.head, this.psi, camera, this.background, share);
    this.panel.show();
    this._tellBeyond();
    this.due = false;
    this.pictures++;
  }

  savePicture() {
    this.draw();
    const link = document.createElement("a");
    link.download = "avatar.png";
    link.href = this.canvas.toDataURL("image/png");
    link.click();
  }

  _tick(now) {
    const seconds = this._last === null ? 0 : Math.min((now - this._last) / 1000, 0.25);
    this._last = now;
    if (this.performance.playing) {
      this.performance.advance(seconds);
      this.theta = this.performance.current();
      this.due = true;
    }
    if (this.orbit.settle(seconds)) this.due = true;
    if (this.due) this.pace.moves(now);
    else this.due = this.pace.rests(now);
    if (this.due) {
      this.draw(this.pace.share);
      this._tellRate(now);
    }
    requestAnimationFrame((next) => this._tick(next));
  }

  /** Whether a number of theta is farther than in the film; there may be none to compare with. */
  isBeyond(place) {
    const [low, high] = this.data.film.theta ?? [];
    return low !== undefined && (this.theta[place] < low[place] || this.theta[place] > high[place]);
  }

  /** What of this picture the film did not show; what is seen then is a guess. */
  _tellBeyond() {
    const { film, layout } = this.data, found = [];
    const [low, high] = film.turn;
    const away = this.turnSeen.map((angle, i) => {
      const off = angle - (low[i] + high[i]) / 2;
      return Math.abs(Math.atan2(Math.sin(off), Math.cos(off))) > (high[i] - low[i]) / 2;
    });
    if (away[0] || away[1]) {
      const i = away[0] ? 0 : 1, sides = [["right", "left"], ["above", "below"]][i];
      const degrees = (angle) => `${Math.round(Math.abs((180 * angle) / Math.PI))}°`;
      const said = (angle) => `${degrees(angle)} ${sides[angle > 0 ? 1 : 0]}`;
      found.push(`seen from ${said(this.turnSeen[i])}, filmed ${said(low[i])} to ${said(high[i])}`);
    }
    found.push(...this.panel.namesBeyond());
    this.beyond.textContent = found.length ? `Beyond the film: ${found.join("; ")}` : "";
  }

  /** Pictures a second while the performance plays, told twice a second. */
  _tellRate(now) {
    if (this.message.className === "error") return;
    if (!this._rateFrom || !this.performance.playing) {
      this._rateFrom = { now, pictures: this.pictures };
      if (!this.performance.playing) this.message.textContent = "";
    } else if (now - this._rateFrom.now > 500) {
      const rate = (1000 * (this.pictures - this._rateFrom.pictures)) / (now - this._rateFrom.now);
      this.message.textContent = `${rate.toFixed(0)} pictures/s, `
        + `${this.data.num_gaussians.toLocaleString("en")} Gaussians`
        + (this.pace.told && `, ${this.pace.told}`);
      this._rateFrom = { now, pictures: this.pictures };
    }
  }
}

/** Resolves to the app when the first picture is there. */
window.rgbavatar = (async () => {
  const message = document.getElementById("message");
  try {
    const data = await AvatarData.open(streamOfPage());
    const app = new App(data, document.getElementById("view"), message);
    app.draw();
    message.textContent = "";
    app.complete = data.complete.catch((error) => {
      message.className = "error";
      message.textContent = error.message;
    });
    return app;
  } catch (error) {
    message.className = "error";
    message.textContent = error.message;
    throw error;
  }
})();
