"use strict";
/* WebGPU: the same picture as renderer.js's, and the choice between the two. */

const GPU_TABLES = [...Object.keys(BASE_TABLES), "anchor"]; // in the order of GPU_PLACE
const GPU_BASES = Object.keys(BASIS_TABLES);
const SCENE_NUMBERS = 32; // of four bytes, as GPU_SCENE has them
const ASKED_LIMITS = ["maxTextureDimension2D", "maxBufferSize", "maxStorageBufferBindingSize"];
const LOST_AGAIN = 1000; // milliseconds until a device is asked for again

class GPURenderer extends GaussianRenderer {
  static kind = "webgpu";

  /** Rejects with a reason where the browser lacks what is needed; the canvas is then untouched. */
  static async create(canvas, data) {
    const adapter = await navigator.gpu?.requestAdapter();
    if (!adapter) throw new Error("This browser has no WebGPU.");
    const device = await adapter.requestDevice({
      requiredLimits: Object.fromEntries(ASKED_LIMITS.map((name) => [name, adapter.limits[name]])),
    });
    try {
      const renderer = new GPURenderer(device, data);
      await renderer._prepare();
      renderer._take(canvas);
      return renderer;
    } catch (error) {
      device.destroy();
      throw error;
    }
  }

  constructor(device, data) {
    super(data);
    this.device = device;
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.pictures = new Map(); // by format
    this.scene = new ArrayBuffer(4 * SCENE_NUMBERS);
  }

  /** Make programs and buffers. */
  async _prepare() {
    const { device } = this, errors = ["validation", "out-of-memory"];
    for (const kind of errors) device.pushErrorScope(kind);
    this._makeBuffers();
    await this._makePrograms();
    for (const error of await Promise.all(errors.map(() => device.popErrorScope()))) {
      if (error) throw new Error(error.message);
    }
  }

  _buffer(bytes, usage) {
    return this.device.createBuffer({ size: bytes, usage: usage | GPUBufferUsage.COPY_DST });
  }

  _makeBuffers() {
    const { STORAGE, UNIFORM, INDEX } = GPUBufferUsage, stride = TEXTURE_WIDTH * this.rows;
    const { rows, corners, edges } = this._faces();
    const faces = new Uint32Array(2 * corners.length), bits = new Uint32Array(edges.buffer);
    for (let at = 0; at < corners.length; at += 4) {
      faces.set(corners.subarray(at, at + 4), 2 * at);
      faces.set(bits.subarray(at, at + 4), 2 * at + 4);
    }
    const vertices = this.data.arrays.neutral_vertices.length / 3, boxes = this._boxCorners();
    this.buffers = {
      scene: this._buffer(this.scene.byteLength, UNIFORM),
      base: this._buffer(16 * stride * GPU_TABLES.length, STORAGE),
      bases: this._buffer(4 * stride * GPU_BASES.length * Math.max(this.numBases, 1), STORAGE),
      weights: this._buffer(this.weightValues.byteLength, STORAGE),
      vertices: this._buffer(16 * TEXTURE_WIDTH * Math.ceil(vertices / TEXTURE_WIDTH), STORAGE),
      faces: this._buffer(32 * TEXTURE_WIDTH * rows, STORAGE),
      placed: this._buffer(48 * stride, STORAGE),
      order: this._buffer(4 * stride, STORAGE),
      corners: this._buffer(boxes.byteLength, INDEX),
    };
    this._write("faces", faces);
    this._write("corners", boxes);
    this.linear = this.device.createSampler({ minFilter: "linear", magFilter: "linear" });
  }

  _write(name, values, at = 0) {
    this.device.queue.writeBuffer(this.buffers[name], at, values);
  }

  async _makePrograms() {
    const { device } = this;
    const [place, draw, show] = [GPU_PLACE, GPU_DRAW, GPU_SHOW].map(
      (code) => device.createShaderModule({ code }));
    const drawn = (module, target) => device.createRenderPipelineAsync({
      layout: "auto", vertex: { module, entryPoint: "corner" },
      fragment: { module, entryPoint: "shade", targets: [target] },
    });
    const over = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
    const overAll = { color: over, alpha: over };
    // Half floats hold the unrounded sums of many thin layers.
    const [placing, exact, bytes, showing] = await Promise.all([
      device.createComputePipelineAsync({
        layout: "auto", compute: { module: place, entryPoint: "main" },
      }),
      drawn(draw, { format: "rgba16float", blend: overAll }),
      drawn(draw, { format: "rgba8unorm", blend: overAll }),
      drawn(show, { format: this.format }),
    ]);
    const { scene, base, bases, weights, vertices, faces, placed, order } = this.buffers;
    this.placing = this._program(placing, [scene, base, bases, weights, vertices, faces, placed]);
    this.drawing = {
      rgba16float: this._program(exact, [scene, order, placed]),
      rgba8unorm: this._program(bytes, [scene, order, placed]),
    };
    this.showing = showing;
  }

  /** A pipeline with what is bound to it. */
  _program(pipeline, buffers) {
    return { pipeline, bound: this._bound(pipeline, buffers.map((buffer) => ({ buffer }))) };
  }

  _bound(pipeline, resources) {
    return this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: resources.map((resource, binding) => ({ binding, resource })),
    });
  }

  /** From here on the canvas can have no other kind of context. */
  _take(canvas) {
    this.context = canvas.getContext("webgpu");
    if (!this.context) throw new Error("The canvas was drawn on with another kind of context.");
    this.context.configure({ device: this.device, format: this.format, alphaMode: "premultiplied" });
  }

  /** Tell when the device is lost, and give the renderer that takes this one's place. */
  watch(lost, restored, signal) {
    this.device.lost.then(async () => {
      if (signal.aborted) return;
      lost();
      const next = await this._replaced(signal);
      if (signal.aborted) {
        next?.dispose();
        return;
      }
      next.watch(lost, restored, signal);
      restored(next);
    });
  }

  async _replaced(signal) {
    while (!signal.aborted) {
      try {
        return await GPURenderer.create(this.context.canvas, this.data);
      } catch { // the driver may still be starting
        await new Promise((resolve) => { setTimeout(resolve, LOST_AGAIN); });
      }
    }
    return null;
  }

  /** Free all graphics memory; another may draw on the canvas. */
  dispose() {
    this.context.unconfigure();
    for (const { texture } of this.pictures.values()) texture.destroy();
    for (const buffer of Object.values(this.buffers)) buffer.destroy();
    this.device.destroy();
  }

  _putBase(table, values, row) {
    const place = this.rows * GPU_TABLES.indexOf(table) + row;
    this._write("base", values, 16 * TEXTURE_WIDTH * place);
  }

  _putBasis(table, k, bytes, row) {
    const place = this.rows * (this.numBases * GPU_BASES.indexOf(table) + k) + row;
    this._write("bases", bytes, 4 * TEXTURE_WIDTH * place);
  }

  /** As large as the camera's picture. */
  _fitPicture({ width, height }, format) {
    const before = this.pictures.get(format);
    if (before?.texture.width === width && before.texture.height === height) return before;
    before?.texture.destroy();
    const { RENDER_ATTACHMENT, TEXTURE_BINDING } = GPUTextureUsage;
    const texture = this.device.createTexture({
      size: [width, height], format, usage: RENDER_ATTACHMENT | TEXTURE_BINDING,
    });
    const view = texture.createView();
    const bound = this._bound(this.showing, [{ buffer: this.buffers.scene }, view, this.linear]);
    const picture = { texture, view, bound };
    this.pictures.set(format, picture);
    return picture;
  }

  /** As the WebGL2 renderer's `draw`. */
  draw(head, psi, seen, background, share = WHOLE) {
    const count = this.count(share), camera = this._reduced(seen, share.resolution);
    this._fill();
    this._fillAnchors(count);
    const format = share.bytes ? "rgba8unorm" : "rgba16float";
    const picture = this._fitPicture(camera, format);
    this._write("order", this._sorted(head, psi, camera, count));
    this._write("vertices", head.vertices);
    this._write("weights", this._weigh(psi));
    this._describe(camera, seen, background, count);
    const commands = this.device.createCommandEncoder();
    const placing = commands.beginComputePass();
    placing.setPipeline(this.placing.pipeline);
    placing.setBindGroup(0, this.placing.bound);
    placing.dispatchWorkgroups(Math.ceil(count / GROUP_SIZE));
    placing.end();
    const drawing = this._pass(commands, picture.view, this.drawing[format]);
    drawing.setIndexBuffer(this.buffers.corners, "uint32");
    drawing.drawIndexed(6 * count);
    drawing.end();
    const showing = this._pass(commands, this.context.getCurrentTexture().createView(),
      { pipeline: this.showing, bound: picture.bound });
    showing.draw(3);
    showing.end();
    this.device.queue.submit([commands.finish()]);
  }

  /** A program's pass over a cleared target. */
  _pass(commands, view, { pipeline, bound }) {
    const pass = commands.beginRenderPass({
      colorAttachments: [{ view, loadOp: "clear", storeOp: "store", clearValue: [0, 0, 0, 0] }],
    });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, bound);
    return pass;
  }

  /** Fill GPU_SCENE. */
  _describe(camera, canvas, background, count) {
    const { rotation, translation, focal, principal } = camera, { low, high } = this._slopes(camera);
    const rows = [0, 1, 2].flatMap((i) => [...rotation.slice(3 * i, 3 * i + 3), translation[i]]);
    const numbers = [
      ...rows, ...focal, ...principal, ...low, ...high,
      ...(background ? [...background, 1] : [0, 0, 0, 0]),
      camera.width, camera.height, canvas.width, canvas.height,
    ];
    new Float32Array(this.scene).set(numbers);
    new Uint32Array(this.scene).set([
      count, this.numBases, VARIANTS.indexOf(this.data.manifest.variant), TEXTURE_WIDTH * this.rows,
    ], numbers.length);
    this._write("scene", this.scene);
  }
}

/**
 * WebGPU's renderer where there is one and WebGL2's else, or the one that is wanted by its kind;
 * rejects with a reason where it cannot be.
 */
async function rendererFor(canvas, data, wanted) {
  if (![undefined, GPURenderer.kind, Renderer.kind].includes(wanted)) {
    throw new RangeError(`renderer is ${inWords(wanted)}; expected "webgpu" or "webgl2".`);
  }
  if (wanted === GPURenderer.kind) return GPURenderer.create(canvas, data);
  if (wanted === undefined && navigator.gpu) {
    try {
      return await GPURenderer.create(canvas, data);
    } catch (error) {
      console.info(`rgbavatar: drawn with WebGL2. ${error.message}`);
    }
  }
  return new Renderer(canvas, data);
}
