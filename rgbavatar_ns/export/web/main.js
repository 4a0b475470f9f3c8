"use strict";
/* The page around an avatar: controls, what is told, `window.rgbavatar` for scripts. */

const NARROW = "(max-width: 700px)"; // a phone's: the face first, the controls on request

class App {
  /** page: what the exporter said of the page, { origins, servers, own_server }. */
  constructor(avatar, page) {
    this.avatar = avatar;
    this.message = document.getElementById("message");
    this.beyond = document.getElementById("beyond");
    this.panel = new Panel(document.getElementById("panel"), this);
    this.driver = new Driver(avatar);
    this._buttons();
    if (window.matchMedia(NARROW).matches) this.fold();
    listenToKeys(this);
    avatar.addEventListener("drawn", () => this._follow());
    avatar.addEventListener("lost", () => {
      this.message.textContent = "The graphics were taken away; waiting for them.";
    });
    avatar.addEventListener("restored", () => { this.message.textContent = ""; });
    this._frameMessages = new FrameMessages(page.origins, this.driver, (...said) => this._live(...said));
    const own = page.own_server ? [`ws://${window.location.host}`] : [];
    this._connect([...page.servers, ...own]);
  }

  /** Play or pause the performance, in place of who drives. */
  play(on) {
    this.takeOver();
    if (on) this.avatar.performance.play();
    else this.avatar.performance.pause();
    this.avatar.changed();
  }

  /** Set one number of theta by hand, which stops the performance. */
  setParameter(place, value) {
    this.takeOver();
    const theta = this.avatar.theta;
    theta[place] = value;
    this.avatar.setTheta(theta);
  }

  /** The calm face from where the camera was first. */
  reset() {
    this.takeOver();
    this.avatar.camera.reset();
    this.avatar.setTheta(this.avatar.neutralTheta);
  }

  /** Who is at the page goes before who drives it, until "Live" gives it back. */
  takeOver() {
    this.driver.active = !this.driver.driven;
    this._showButtons();
  }

  /** Hide the controls, or show them again. */
  fold() {
    document.body.classList.toggle("full");
    this._showButtons();
  }

  savePicture() {
    this.avatar.draw();
    const link = document.createElement("a");
    link.download = "avatar.png";
    link.href = this.avatar.canvas.toDataURL("image/png");
    link.click();
  }

  /** Whether a number of theta is farther than in the film; there may be none to compare with. */
  isBeyond(place) {
    const [low, high] = this.avatar.data.manifest.film.theta ?? [], value = this.avatar.theta[place];
    return low !== undefined && (value < low[place] || value > high[place]);
  }

  _buttons() {
    const by = (id, act) => {
      const button = document.getElementById(id);
      button.addEventListener("click", act);
      return button;
    };
    this.playButton = by("play", () => this.play(!this.avatar.performance.playing));
    this.playButton.hidden = this.avatar.performance.length === 0;
    this.liveButton = by("live-again", () => { this.driver.active = true; this._showButtons(); });
    this.calibrateButton = by("calibrate", () => this.connection.calibrate());
    this.foldButton = by("fold", () => this.fold());
    this._showButtons();
  }

  _showButtons() {
    this.playButton.textContent = this.avatar.performance.playing ? "Pause" : "Play";
    this.liveButton.hidden = this.driver.active;
    this.calibrateButton.hidden = !this.connection?.connected;
    const folded = document.body.classList.contains("full");
    this.foldButton.textContent = folded ? "Controls" : "Hide controls";
    this.foldButton.setAttribute("aria-expanded", String(!folded));
  }

  /** Be driven by the server that the page's address names. */
  _connect(servers) {
    const wanted = new URLSearchParams(window.location.search).get("ws");
    if (wanted === null) return;
    const tell = (...said) => this._live(...said);
    try {
      this.connection = new LiveConnection(driveAddress(wanted, servers), this.driver, tell);
    } catch (error) {
      tell(error.message, true);
    }
  }

  _live(text, isProblem) {
    const told = document.getElementById("live");
    if (told.textContent !== text) told.textContent = text; // screen readers speak of changes
    told.classList.toggle("problem", isProblem);
    this._showButtons();
  }

  /** After a picture. */
  _follow() {
    this.panel.show();
    this._showButtons();
    this._tellBeyond();
    this._tellRate(performance.now());
  }

  /** What of this picture the film did not show; what is seen then is a guess. */
  _tellBeyond() {
    const { film } = this.avatar.data.manifest, seen = this.avatar.turnSeen, found = [];
    const [low, high] = film.turn;
    const away = seen.map((angle, i) => {
      const off = angle - (low[i] + high[i]) / 2;
      return Math.abs(Math.atan2(Math.sin(off), Math.cos(off))) > (high[i] - low[i]) / 2;
    });
    if (away[0] || away[1]) {
      const i = away[0] ? 0 : 1, sides = [["right", "left"], ["above", "below"]][i];
      const degrees = (angle) => `${Math.round(Math.abs((180 * angle) / Math.PI))}°`;
      const said = (angle) => `${degrees(angle)} ${sides[angle > 0 ? 1 : 0]}`;
      found.push(`seen from ${said(seen[i])}, filmed ${said(low[i])} to ${said(high[i])}`);
    }
    found.push(...this.panel.namesBeyond());
    this.beyond.textContent = found.length ? `Beyond the film: ${found.join("; ")}` : "";
  }

  /** Pictures a second while the performance plays, told twice a second. */
  _tellRate(now) {
    if (this.message.className === "error") return;
    const { pictures } = this.avatar, { playing } = this.avatar.performance;
    if (!this._rateFrom || !playing) {
      this._rateFrom = { now, pictures };
      if (!playing) this.message.textContent = "";
    } else if (now - this._rateFrom.now > 500) {
      const rate = (1000 * (pictures - this._rateFrom.pictures)) / (now - this._rateFrom.now);
      this.message.textContent = `${rate.toFixed(0)} pictures/s, `
        + `${this.avatar.data.manifest.num_gaussians.toLocaleString("en")} Gaussians`
        + (this.avatar.pace && `, ${this.avatar.pace}`);
      this._rateFrom = { now, pictures };
    }
  }
}

/** Resolves to the app when the first picture is there. */
window.rgbavatar = (async () => {
  const message = document.getElementById("message");
  try {
    const page = JSON.parse(document.getElementById("page").textContent);
    const renderer = new URLSearchParams(window.location.search).get("renderer") ?? undefined;
    const avatar = await RGBAvatar.load(
      streamOfPage(), document.getElementById("view"), { renderer });
    message.textContent = "";
    const app = new App(avatar, page);
    avatar.draw();
    avatar.complete.catch((error) => { // what is there of it stays
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
