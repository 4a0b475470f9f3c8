"use strict";
/* WebGL2: places all Gaussians in one pass, draws them from far to near, shows the picture. */

class Renderer extends GaussianRenderer {
  static kind = "webgl2";

  /** Throws an Error with a reason where the browser lacks what is needed. */
  constructor(canvas, data) {
    super(data);
    // Kept after drawing, so that the picture can be saved and compared.
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2, which the avatar is drawn with.");
    if (!gl.getExtension("EXT_color_buffer_float")) {
      throw new Error("This graphics driver cannot draw to float textures; try another browser.");
    }
    this.gl = gl;
    this._made = []; // what frees each object of the graphics memory
    this.placing = this._program(WHOLE_TARGET_VERTEX, PLACE_FRAGMENT);
    this.drawing = this._program(DRAW_VERTEX, DRAW_FRAGMENT);
    this.showing = this._program(WHOLE_TARGET_VERTEX, SHOW_FRAGMENT);
    this._makeTextures();
    this._makePlaceTarget();
    this._makeBoxes();
    this.pictures = new Map(); // textures by format
    this.pictureTarget = this._framebuffer();
  }

  _program(vertexSource, fragmentSource) {
    const gl = this.gl, program = gl.createProgram();
    for (const [type, source] of [
      [gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource],
    ]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader); // goes with its program
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(`A shader was refused: ${gl.getShaderInfoLog(shader)}`);
      }
    }
    gl.linkProgram(program);
    this._made.push(() => gl.deleteProgram(program));
    const uniforms = {};
    const number = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < number; i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  _texture(target = this.gl.TEXTURE_2D) {
    const gl = this.gl, texture = gl.createTexture();
    this._made.push(() => gl.deleteTexture(texture));
    gl.bindTexture(target, texture);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.NEAREST], [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(target, name, value);
    return { target, texture };
  }

  _framebuffer() {
    const gl = this.gl, made = gl.createFramebuffer();
    this._made.push(() => gl.deleteFramebuffer(made));
    return made;
  }

  /** Tell when the context is lost, and give the renderer that takes this one's place. */
  watch(lost, restored, signal) {
    const { canvas } = this.gl;
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // else it is never given back
      lost();
    }, { signal });
    canvas.addEventListener("webglcontextrestored", () => {
      restored(new Renderer(canvas, this.data));
    }, { signal });
  }

  /** Free all graphics memory; another may draw on the canvas. */
  dispose() {
    for (const free of this._made) free();
    this._made = [];
  }

  /** A texture of rows of 1,024 texels, each with some of these numbers. */
  _table(format, width, height, values = null) {
    const gl = this.gl, made = { ...this._texture(), width, height, format };
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[format], width, height);
    if (values !== null) this._renew(made, values);
    return made;
  }

  /** Replace whole rows of a table, from one on; values: of as many rows as they are. */
  _renew({ texture, width, format }, values, row = 0) {
    const gl = this.gl, [numbers, kind, components] = {
      RGBA32F: [gl.RGBA, gl.FLOAT, 4], RGBA32UI: [gl.RGBA_INTEGER, gl.UNSIGNED_INT, 4],
      R32UI: [gl.RED_INTEGER, gl.UNSIGNED_INT, 1],
    }[format];
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const height = values.length / (components * width);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, numbers, kind, values);
  }

  /** Bases as signed bytes, a layer each; at least one layer, which nobody reads, is needed. */
  _layers() {
    const gl = this.gl, made = this._texture(gl.TEXTURE_2D_ARRAY);
    const layers = Math.max(this.numBases, 1);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8_SNORM, TEXTURE_WIDTH, this.rows, layers);
    return made;
  }

  _makeTextures() {
    const table = () => this._table("RGBA32F", TEXTURE_WIDTH, this.rows);
    this.gaussians = {
      scaleOpacity: table(), baseRotation: table(), baseColor: table(), basePosition: table(),
      anchor: table(),
      basisRotation: this._layers(), basisColor: this._layers(), basisPosition: this._layers(),
    };
    const { rows, corners, edges } = this._faces(), { neutral_vertices: n } = this.data.arrays;
    this.head = {
      corners: this._table("RGBA32UI", TEXTURE_WIDTH, rows, corners),
      edgesToFrame: this._table("RGBA32F", TEXTURE_WIDTH, rows, edges),
      vertex: this._table("RGBA32F", TEXTURE_WIDTH,
        Math.ceil(n.length / 3 / TEXTURE_WIDTH)),
    };
    this.weights = this._table("RGBA32F", Math.max(this.numBases, 1), 3);
  }

  _putBase(table, values, row) {
    this._renew(this.gaussians[table], values, row);
  }

  _putBasis(table, k, bytes, row) {
    const gl = this.gl, rows = bytes.length / (4 * TEXTURE_WIDTH);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.gaussians[table].texture);
    gl.texSubImage3D(
      gl.TEXTURE_2D_ARRAY, 0, 0, row, k, TEXTURE_WIDTH, rows, 1, gl.RGBA, gl.BYTE, bytes);
  }

  _makePlaceTarget() {
    const gl = this.gl, table = () => this._table("RGBA32F", TEXTURE_WIDTH, this.rows);
    this.placed = { place: table(), shape: table(), shade: table() };
    this.placeTarget = this._framebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.placeTarget);
    const attachments = Object.values(this.placed).map(({ texture }, i) => {
      const place = gl.COLOR_ATTACHMENT0 + i;
      gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, texture, 0);
      return place;
    });
    gl.drawBuffers(attachments);
  }

  _makeBoxes() {
    const gl = this.gl;
    this.boxes = gl.createVertexArray();
    const buffer = gl.createBuffer();
    this._made.push(() => gl.deleteVertexArray(this.boxes), () => gl.deleteBuffer(buffer));
    gl.bindVertexArray(this.boxes);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this._boxCorners(), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.orderTable = this._table("R32UI", TEXTURE_WIDTH, this.rows);
  }

  /** Half floats hold the unrounded sums of many thin layers. */
  _fitPicture(width, height, bytes) {
    const gl = this.gl, format = bytes ? gl.RGBA8 : gl.RGBA16F;
    if (!this.pictures.has(format)) {
      this.pictures.set(format, { ...this._texture(), width: 0, height: 0 });
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
        gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
      }
    }
    const picture = this.picture = this.pictures.get(format);
    if (picture.width !== width || picture.height !== height) {
      gl.bindTexture(gl.TEXTURE_2D, picture.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA,
        bytes ? gl.UNSIGNED_BYTE : gl.HALF_FLOAT, null);
      Object.assign(picture, { width, height });
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.pictureTarget);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture.texture, 0);
  }

  /** Bind textures to a program's samplers by their names. */
  _bind(uniforms, textures) {
    const gl = this.gl;
    Object.entries(textures).forEach(([name, { target, texture }], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
      gl.uniform1i(uniforms[name], unit);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  /**
   * Draw a posed head with weights psi, seen by a camera of the canvas's size. share: of the detail
   * and of the sides' pixels, each in (0, 1], and whether the sums are rounded and held to 0..1
   * after each Gaussian (bytes), which saves a third of the time (`Pace`).
   */
  draw(head, psi, seen, background, share = WHOLE) {
    const count = this.count(share), camera = this._reduced(seen, share.resolution);
    this._fill();
    this._fillAnchors(count);
    // What is kept in bytes and is as large as the canvas needs no place of its own.
    const direct = share.bytes && share.resolution === 1 && background;
    if (!direct) this._fitPicture(camera.width, camera.height, share.bytes);
    this._renew(this.orderTable, this._sorted(head, psi, camera, count));
    this._renew(this.head.vertex, head.vertices);
    this._renew(this.weights, this._weigh(psi));
    this._placeAll(camera, count);
    if (direct) {
      this._drawAll(camera, count, null, [...background, 1]);
    } else {
      this._drawAll(camera, count, this.pictureTarget, [0, 0, 0, 0]);
      this._showOver(background, seen);
    }
  }

  _placeAll(camera, count) {
    const gl = this.gl, { program, uniforms } = this.placing;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.placeTarget);
    gl.viewport(0, 0, TEXTURE_WIDTH, Math.ceil(count / TEXTURE_WIDTH));
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    this._bind(uniforms, { ...this.gaussians, ...this.head, weights: this.weights });
    gl.uniform1i(uniforms.count, count);
    gl.uniform1i(uniforms.numBases, this.numBases);
    gl.uniform1i(uniforms.variant, VARIANTS.indexOf(this.data.manifest.variant));
    const { rotation, translation, focal, principal } = camera;
    gl.uniform3fv(uniforms.cameraX, rotation.slice(0, 3));
    gl.uniform3fv(uniforms.cameraY, rotation.slice(3, 6));
    gl.uniform3fv(uniforms.cameraZ, rotation.slice(6, 9));
    gl.uniform3fv(uniforms.cameraTranslation, translation);
    gl.uniform2fv(uniforms.focal, focal);
    gl.uniform2fv(uniforms.principal, principal);
    const { low, high } = this._slopes(camera);
    gl.uniform2fv(uniforms.slopeLow, low);
    gl.uniform2fv(uniforms.slopeHigh, high);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** From far to near over a colour, into a target; null is the canvas. */
  _drawAll({ width, height }, count, target, ground) {
    const gl = this.gl, { program, uniforms } = this.drawing;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...ground);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    this._bind(uniforms, { ...this.placed, order: this.orderTable });
    gl.uniform2f(uniforms.imageSize, width, height);
    gl.bindVertexArray(this.boxes);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  _showOver(background, { width, height }) {
    const gl = this.gl, { program, uniforms } = this.showing;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    this._bind(uniforms, { picture: this.picture });
    gl.uniform4fv(uniforms.background, background ? [...background, 1] : [0, 0, 0, 0]);
    gl.uniform2f(uniforms.size, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
