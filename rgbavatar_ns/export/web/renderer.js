"use strict";
/* WebGL2: blends all Gaussians in one pass, draws them from far to near, shows the picture. */

const TEXTURE_WIDTH = 1024;

class Renderer {
  /** Throws an Error with a reason where the browser lacks what is needed. */
  constructor(canvas, data) {
    // Kept after drawing, so that the picture can be saved and compared.
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2, which the avatar is drawn with.");
    if (!gl.getExtension("EXT_color_buffer_float")) {
      throw new Error("This graphics driver cannot draw to float textures; try another browser.");
    }
    this.gl = gl;
    this.canvas = canvas;
    this._made = []; // what frees each object of the graphics memory
    this.count = data.num_gaussians;
    this.numBases = data.num_bases;
    this.rows = Math.ceil(this.count / TEXTURE_WIDTH);
    this.blend = this._program(WHOLE_TARGET_VERTEX, BLEND_FRAGMENT);
    this.drawing = this._program(DRAW_VERTEX, DRAW_FRAGMENT);
    this.show = this._program(WHOLE_TARGET_VERTEX, SHOW_FRAGMENT);
    this._upload(data);
    this._makeBlendTarget();
    this._makeBoxes();
    this.pictureSize = [0, 0];
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

  /** A float texture with four numbers a texel, in rows of 1,024. */
  _floats(values, width = TEXTURE_WIDTH) {
    const gl = this.gl, made = this._texture();
    const height = values.length / (4 * width);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, values);
    return { ...made, width, height };
  }

  _framebuffer() {
    const gl = this.gl, made = gl.createFramebuffer();
    this._made.push(() => gl.deleteFramebuffer(made));
    return made;
  }

  /** Free all graphics memory; the canvas may be drawn on by another. */
  dispose() {
    for (const free of this._made) free();
    this._made = [];
  }

  _renew(floats, values) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, floats.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, floats.width, floats.height, gl.RGBA, gl.FLOAT, values);
  }

  /** Bases as signed bytes, a layer each; at least one layer, which nobody reads, is needed. */
  _layers(values) {
    const gl = this.gl, made = this._texture(gl.TEXTURE_2D_ARRAY);
    const layers = Math.max(this.numBases, 1);
    const bytes = this.numBases ? values : new Int8Array(4 * TEXTURE_WIDTH * this.rows);
    gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGBA8_SNORM, TEXTURE_WIDTH, this.rows, layers, 0,
      gl.RGBA, gl.BYTE, bytes);
    return made;
  }

  _upload(data) {
    const a = data.arrays, texels = TEXTURE_WIDTH * this.rows;
    this.fixed = {
      scaleOpacity: this._floats(a.scale_opacity),
      baseRotation: this._floats(a.rotation),
      baseColor: this._floats(a.color_triangle),
      basisRotation: this._layers(a.basis_rotation),
      basisColor: this._layers(a.basis_color),
    };
    this.rotationUnit = a.basis_rotation_unit;
    this.colorUnit = a.basis_color_unit;
    this.weightValues = new Float32Array(8 * Math.max(this.numBases, 1));
    const triangleRows = Math.ceil(a.triangle_vertices.length / 3 / TEXTURE_WIDTH);
    this.moving = {
      position: this._floats(new Float32Array(4 * texels)),
      triangleRotation: this._floats(new Float32Array(4 * TEXTURE_WIDTH * triangleRows)),
      weights: this._floats(this.weightValues, Math.max(this.numBases, 1)),
    };
  }

  _makeBlendTarget() {
    const gl = this.gl, empty = new Float32Array(4 * TEXTURE_WIDTH * this.rows);
    this.projected = {
      place: this._floats(empty), shape: this._floats(empty), shade: this._floats(empty),
    };
    this.blendTarget = this._framebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.blendTarget);
    const attachments = Object.values(this.projected).map(({ texture }, i) => {
      const place = gl.COLOR_ATTACHMENT0 + i;
      gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, texture, 0);
      return place;
    });
    gl.drawBuffers(attachments);
  }

  /** Four corners and two triangles for each Gaussian; instances of four are slow to start. */
  _makeBoxes() {
    const gl = this.gl, corners = new Uint32Array(6 * this.count);
    for (let i = 0; i < this.count; i++) {
      corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    }
    this.boxes = gl.createVertexArray();
    const buffer = gl.createBuffer();
    this._made.push(() => gl.deleteVertexArray(this.boxes), () => gl.deleteBuffer(buffer));
    gl.bindVertexArray(this.boxes);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.order = this._texture();
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, TEXTURE_WIDTH, this.rows);
  }

  _renewOrder(order) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, this.order.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, this.rows, gl.RED_INTEGER,
      gl.UNSIGNED_INT, order);
  }

  /** Half floats hold the unrounded sums of many thin layers. */
  _fitPicture(width, height) {
    if (this.pictureSize[0] === width && this.pictureSize[1] === height) return;
    const gl = this.gl;
    if (this.picture) gl.deleteTexture(this.picture.texture);
    this.picture = this._texture();
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    this.pictureTarget = this.pictureTarget || this._framebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.pictureTarget);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture.texture, 0);
    this.pictureSize = [width, height];
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

  /** Draw sorted positions on a posed head with weights psi, seen by a camera of canvas size. */
  draw(positions, head, psi, camera, background) {
    const gl = this.gl, { width, height } = camera;
    this._fitPicture(width, height);
    this._renew(this.moving.position, positions.world);
    this._renew(this.moving.triangleRotation, head.quaternions);
    for (let k = 0; k < this.numBases; k++) {
      for (let i = 0; i < 4; i++) {
        // A byte of 127 is read as 1.
        this.weightValues[4 * k + i] = psi[k] * 127 * this.rotationUnit[4 * k + i];
        const color = i < 3 ? psi[k] * 127 * this.colorUnit[3 * k + i] : 0;
        this.weightValues[4 * (this.numBases + k) + i] = color;
      }
    }
    this._renew(this.moving.weights, this.weightValues);
    this._renewOrder(positions.order);
    this._blendAll(camera);
    this._drawAll(camera);
    this._showOver(background, camera);
  }

  _blendAll(camera) {
    const gl = this.gl, { program, uniforms } = this.blend;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.blendTarget);
    gl.viewport(0, 0, TEXTURE_WIDTH, this.rows);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    this._bind(uniforms, { ...this.fixed, ...this.moving });
    gl.uniform1i(uniforms.count, this.count);
    gl.uniform1i(uniforms.numBases, this.numBases);
    const { rotation, translation, focal, principal, width, height } = camera;
    gl.uniform3fv(uniforms.cameraX, rotation.slice(0, 3));
    gl.uniform3fv(uniforms.cameraY, rotation.slice(3, 6));
    gl.uniform3fv(uniforms.cameraZ, rotation.slice(6, 9));
    gl.uniform3fv(uniforms.cameraTranslation, translation);
    gl.uniform2fv(uniforms.focal, focal);
    gl.uniform2fv(uniforms.principal, principal);
    // The projection is linearised no further outside the image than this.
    const size = [width, height];
    const margin = size.map((length, i) => (0.3 * 0.5 * length) / focal[i]);
    const low = principal.map((centre, i) => -centre / focal[i] - margin[i]);
    const high = principal.map((centre, i) => (size[i] - centre) / focal[i] + margin[i]);
    gl.uniform2fv(uniforms.slopeLow, low);
    gl.uniform2fv(uniforms.slopeHigh, high);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  _drawAll({ width, height }) {
    const gl = this.gl, { program, uniforms } = this.drawing;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.pictureTarget);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    this._bind(uniforms, { ...this.projected, order: this.order });
    gl.uniform2f(uniforms.imageSize, width, height);
    gl.bindVertexArray(this.boxes);
    gl.drawElements(gl.TRIANGLES, 6 * this.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  _showOver(background, { width, height }) {
    const gl = this.gl, { program, uniforms } = this.show;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    this._bind(uniforms, { picture: this.picture });
    gl.uniform4fv(uniforms.background, background ? [...background, 1] : [0, 0, 0, 0]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
