"use strict";
/* An avatar on a canvas: what it shows is set, and a picture follows with the next frame. */

const MOST_PIXELS_PER_POINT = 2; // a phone's third pixel costs half as much again and is not seen

class RGBAvatar extends EventTarget {
  /**
   * Load an avatar and draw it once. source: the address of an avatar file, a ReadableStream of its
   * bytes, or { data } that was loaded before. options: background ([r, g, b] in 0..1; null is
   * transparent; by default the avatar's own), controls (pointers turn, move and zoom; true),
   * automatic (draws by itself after every change; true), renderer ("webgpu" or "webgl2"; by default
   * the first that the browser has). Rejects with an Error that says what is wrong with the file or
   * the browser.
   */
  static async load(source, canvas, options = {}) {
    if (!(canvas instanceof HTMLCanvasElement)) {
      throw new TypeError(`canvas is ${inWords(canvas)}; expected a canvas element.`);
    }
    const data = await dataOf(source);
    const avatar = new RGBAvatar(await rendererFor(canvas, data, options.renderer), canvas, options);
    avatar.draw();
    return avatar;
  }

  /** A pose for `setARKit`; see arkit.js. */
  static poseOfMatrix(matrix, metresPerUnit) {
    return poseOfMatrix(matrix, metresPerUnit);
  }

  /** A camera for `setCamera`; see camera.js. */
  static openGLCamera(view, projection, width, height) {
    return openGLCamera(view, projection, width, height);
  }

  constructor(renderer, canvas, { background, controls = true, automatic = true }) {
    super();
    const { data } = renderer, { manifest, arrays } = data;
    this.data = data;
    this.canvas = canvas;
    this._fields = new ThetaFields(manifest.layout);
    this._head = new Head(data);
    this._network = new WeightNetwork(data);
    this._detail = 1;
    this._pace = new Pace();
    this._renderer = renderer;
    this._kind = renderer.constructor.kind;
    this._neutral = Array.from(arrays.neutral_theta);
    this._arkit = manifest.arkit
      && new ARKitMap(manifest.arkit, arrays.arkit_theta, this._fields, this._neutral);
    this.performance = new RecordedPerformance(data, (theta) => this._show(theta));
    this.camera = new OrbitCamera(manifest.camera, manifest.film.turn_reach);
    this._foreignCamera = null;
    this._background = background === undefined ? manifest.background : readColor(background);
    this._heldWeights = new Map(); // psi against the network, by number
    this._size = null; // of the picture in pixels, where a program has set it
    this._theta = this._neutral.slice();
    this._psi = [];
    this._pictures = 0;
    this._due = true;
    this._automatic = automatic;
    this._ended = new AbortController();
    this._last = null;
    this._pixelRatio = window.devicePixelRatio;
    const { signal } = this._ended, arrived = () => this._arrived();
    data.arrivals.add(arrived);
    signal.addEventListener("abort", () => data.arrivals.delete(arrived));
    if (controls) {
      const { touchAction } = canvas.style;
      canvas.style.touchAction = "none"; // a finger turns the head and scrolls no page
      signal.addEventListener("abort", () => { canvas.style.touchAction = touchAction; });
      this.camera.listen(canvas, () => this.changed(), signal);
    }
    const observer = new ResizeObserver(() => this.changed());
    observer.observe(canvas);
    signal.addEventListener("abort", () => observer.disconnect());
    renderer.watch(() => this._lose(), (next) => this._restore(next), signal);
    this._frame = requestAnimationFrame((now) => this._tick(now));
  }

  /** Resolves when all of it has arrived; rejects with an Error where it does not. */
  get complete() {
    return this.data.complete;
  }

  /** Whether WebGPU or WebGL2 draws: "webgpu" or "webgl2". */
  get rendererKind() {
    return this._kind;
  }

  /** Theta's fields in order: { name, size, form }. */
  get layout() {
    return this._fields.layout;
  }

  get expressionNames() {
    return this.data.manifest.expression_names;
  }

  /** The names that `setARKit` knows; none of a head that is no face to it. */
  get arkitNames() {
    return this._arkit ? this._arkit.names : [];
  }

  /** Theta of the calm face that is shown first. */
  get neutralTheta() {
    return this._neutral.slice();
  }

  /** What is shown. */
  get theta() {
    return this._theta.slice();
  }

  /** Weights of the learned bases in the last picture. */
  get psi() {
    return this._psi.slice();
  }

  /** Yaw and pitch in radians as the last picture's camera sees the head. */
  get turnSeen() {
    return this._turnSeen;
  }

  /** The middle of the head in its world, in metres, as in the last picture. */
  get headCentre() {
    return this._head.centre();
  }

  /** Drawn so far. */
  get pictures() {
    return this._pictures;
  }

  /** [r, g, b] in 0..1, or null for transparent. */
  get background() {
    return this._background;
  }

  set background(color) {
    this._background = readColor(color);
    this.changed();
  }

  /** Show a theta and pause the performance; throws TypeError or RangeError where it is none. */
  setTheta(theta) {
    const read = this._fields.read(theta);
    this.performance.leave();
    this._show(read);
  }

  /**
   * Show ARKit's blend shapes, { jawOpen: 0.4, ... }, with a pose { rotation: axis-angle in radians
   * in the head's axes (x its left, y up, z out of the face), translation in metres }. What is
   * missing is as in the neutral face. Throws TypeError or RangeError as `setTheta` does.
   */
  setARKit(coefficients, pose) {
    if (!this._arkit) throw new Error("This avatar's head has no ARKit blend shapes.");
    this.setTheta(this._arkit.theta(coefficients, pose));
  }

  /** See the head from these angles in radians, from the first camera's; no farther than it holds. */
  orbit(yaw, pitch) {
    readNumbers([yaw, pitch], 2, "[yaw, pitch]");
    this._foreignCamera = null;
    this.camera.turnTo(yaw, pitch);
    this.changed();
  }

  /**
   * See it through a camera of another program: rotation (9 numbers, head's world to camera, row by
   * row) and translation (metres), camera axes x right, y down, z forward; focal and principal in
   * pixels of a picture of width x height, which is stretched over the canvas. null: its own again.
   */
  setCamera(camera) {
    this._foreignCamera = camera === null ? null : readCamera(camera);
    this.changed();
  }

  /** Hold weight k of the learned bases against the network; null lets it go. */
  holdWeight(k, value) {
    const count = this.data.manifest.num_bases;
    if (!(Number.isInteger(k) && k >= 0 && k < count)) {
      throw new RangeError(`k is ${inWords(k)}; expected 0 to ${count - 1}.`);
    }
    if (value === null) this._heldWeights.delete(k);
    else this._heldWeights.set(k, readNumbers([value], 1, "[value]")[0]);
    this.changed();
  }

  isHeld(k) {
    return this._heldWeights.has(k);
  }

  /** Fix the picture's size in pixels; without arguments it follows the canvas's place again. */
  setSize(width, height) {
    this._size = width === undefined ? null : readNumbers([width, height], 2, "[width, height]")
      .map((side) => Math.max(1, Math.round(side)));
    this.changed();
  }

  /** The share of the Gaussians that is drawn, the most needed ones first; in (0, 1]. */
  get detail() {
    return this._detail;
  }

  set detail(share) {
    if (!(share > 0 && share <= 1)) throw new RangeError(`detail is ${inWords(share)}; expected (0, 1].`);
    this._detail = share;
    this.changed();
  }

  /** Have a new picture drawn. */
  changed() {
    this._due = true;
  }

  /** What is left out while something moves, in words; empty where nothing is. */
  get pace() {
    return this._pace.told;
  }

  /** Draw now; an event "drawn" follows. Nothing where the context is lost or all is disposed of. */
  draw() {
    this._draw(WHOLE);
  }

  _draw(share) {
    if (!this._renderer) return;
    const [width, height] = this._fitCanvas();
    const head = this._head;
    this._psi = this._network.evaluate(this._theta);
    for (const [k, value] of this._heldWeights) this._psi[k] = value;
    head.pose(this._theta);
    this.camera.seen = viewAngles(multiply3(this.camera.home.rotation, head.turn));
    const camera = this._foreignCamera ? resizedCamera(this._foreignCamera, width, height)
      : this.camera.at(width, height, head.centre());
    this._turnSeen = viewAngles(multiply3(camera.rotation, head.turn));
    this._renderer.detail = this._detail;
    this._renderer.draw(head, this._psi, camera, this._background, share);
    this._due = false;
    this._pictures++;
    this.dispatchEvent(new Event("drawn"));
  }

  /** Free the graphics memory and stop; afterwards nothing is drawn. */
  dispose() {
    this._ended.abort();
    cancelAnimationFrame(this._frame);
    this.performance.pause();
    if (this._renderer) this._renderer.dispose();
    this._renderer = null;
  }

  _show(theta) {
    this._theta = theta;
    this.changed();
  }

  /** There is more to draw. */
  _arrived() {
    this.performance.arrived();
    this.changed();
  }

  /** The canvas's size in pixels, brought to what it is to be. */
  _fitCanvas() {
    const canvas = this.canvas;
    const pixels = Math.min(window.devicePixelRatio || 1, MOST_PIXELS_PER_POINT);
    const [width, height] = this._size ?? [
      Math.max(1, Math.round(canvas.clientWidth * pixels)),
      Math.max(1, Math.round(canvas.clientHeight * pixels)),
    ];
    if (canvas.width === width && canvas.height === height) return [width, height];
    const { clientWidth, clientHeight } = canvas;
    canvas.width = width;
    canvas.height = height;
    // Where no style gives it a place, its pixels would: it would grow with every picture.
    if (Math.abs(canvas.clientWidth - clientWidth) > 1) canvas.style.width = `${clientWidth}px`;
    if (Math.abs(canvas.clientHeight - clientHeight) > 1) canvas.style.height = `${clientHeight}px`;
    return [width, height];
  }

  _tick(now) {
    this._frame = requestAnimationFrame((next) => this._tick(next));
    const seconds = this._last === null ? 0 : Math.min((now - this._last) / 1000, 0.25);
    this._last = now;
    this.performance.advance(seconds);
    if (window.devicePixelRatio !== this._pixelRatio) { // on another screen, or magnified
      this._pixelRatio = window.devicePixelRatio;
      this._due = true;
    }
    if (this.camera.settle(seconds)) this._due = true;
    if (!this._automatic) return;
    if (this._due) this._pace.moves(now);
    else this._due = this._pace.rests(now);
    if (this._due) this._draw(this._pace.share);
  }

  /** The driver takes the graphics away. */
  _lose() {
    this._renderer = null;
    console.warn("rgbavatar: the graphics context was lost; the picture comes back with it.");
    this.dispatchEvent(new Event("lost"));
  }

  _restore(renderer) {
    this._renderer = renderer;
    this.changed();
    this.dispatchEvent(new Event("restored"));
  }
}

/** [r, g, b] in 0..1 or null. */
function readColor(color) {
  if (color === null) return null;
  return readNumbers(color, 3, "background").map((value) => clamp(value, [0, 1]));
}

/** The data of what `RGBAvatar.load` takes. */
async function dataOf(source) {
  if (typeof source === "string" || source instanceof URL) {
    const response = await fetch(source);
    if (!response.ok) throw new Error(`${source} cannot be loaded: status ${response.status}.`);
    return AvatarData.open(response.body);
  }
  if (source instanceof ReadableStream) return AvatarData.open(source);
  if (source?.data instanceof AvatarData) return source.data;
  throw new TypeError(`source is ${inWords(source)}; expected an address, a ReadableStream or { data }.`);
}
